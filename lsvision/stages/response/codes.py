"""Codes of a reference: lines spread over a scan, and robust means of them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.image.brightness import white_level
from lsvision.image.levels import CameraLevels
from lsvision.image.missing import missing_mask
from lsvision.types import LineImage


@dataclass(frozen=True)
class ReferenceCodes:
    """Codes ``(lines, width, channels)``, float32, in blocks of ``block`` consecutive lines.

    Attributes:
        starts: the first line of each block in the scan.
        clipped: share of each column's samples that are saturated, ``(width, channels)``.
        white: the largest number of as many bits as the codes use.
    """

    codes: Float[Tensor, "lines width channels"]
    block: int
    starts: tuple[int, ...]
    clipped: Float[Tensor, "width channels"]
    white: float

    @classmethod
    def read(cls, image: LineImage, most_lines: int, blocks: int) -> "ReferenceCodes":
        """Those of at most ``most_lines`` lines of an image; lines that are not there are passed over."""
        lines = image.shape[0]
        block = max(2, min(lines, most_lines) // blocks)
        count = max(1, min(blocks, lines // block))
        starts = [index * (lines - block) // max(count - 1, 1) for index in range(count)]
        present = [start for start in starts if not bool(missing_mask(image, torch.arange(start, start + block)).any())]
        white = white_level(image)
        levels = CameraLevels.of(image, white)
        parts, clipped = [], torch.zeros(image.shape[1:])
        for start in present:
            raw = image.read(start, start + block)
            saturated = levels.saturated(raw)
            clipped += 0.0 if saturated is None else saturated.float().mean(0) / len(present)
            parts.append(raw.to(torch.float32))
        return cls(torch.cat(parts or [torch.empty(0, *image.shape[1:])]), block, tuple(present), clipped, white)

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.codes)

    @property
    def noise(self) -> float:
        """Standard deviation of a sample by how much neighbouring lines differ; what changes slowly takes no part."""
        return float(self.codes.diff(dim=0).square().mean(0).median().div(2).sqrt())


def grouped_median(codes: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """Median along the lines of whole codes, each of which stands for an interval of one code around it.

    It resolves parts of a code, and codes of 0 that stand for all below do not move it while fewer than half are.

    Source: the median of grouped data, e.g. Yule & Kendall 1950.
    """
    middle = median(codes)
    below = (codes < middle).sum(0)
    at = (codes == middle).sum(0)
    return middle - 0.5 + (len(codes) / 2 - below) / at


def median(values: Float[Tensor, "samples *batch"]) -> Float[Tensor, "*batch"]:
    """The lower median along the lines; NumPy's partition takes a quarter of the time of torch's median."""
    place = (len(values) - 1) // 2
    return torch.from_numpy(np.partition(values.numpy(), place, axis=0)[place])


def clipped_mean(
    values: Float[Tensor, "samples *batch"], center: Float[Tensor, "*batch"], reach: float
) -> Float[Tensor, "*batch"]:
    """Mean along the lines of the values within ``reach`` robust standard deviations of a centre: dirt stays out."""
    inside = near(values, center, reach)
    return (values * inside).sum(0) / inside.sum(0)


def near(
    values: Float[Tensor, "samples *batch"], center: Float[Tensor, "*batch"], reach: float
) -> Bool[Tensor, "samples *batch"]:
    """Which values lie within ``reach`` robust standard deviations of a centre, half a code or more."""
    off = (values - center).abs()
    return off <= (reach * NORMAL_OVER_MAD * median(off)).clamp(min=0.5)
