"""Lines of an image as they are matched: grey values, and which samples carry no measurement."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from lsvision.image.brightness import gray, gray_bytes
from lsvision.image.levels import CameraLevels
from lsvision.image.resampled import ResampledImage
from lsvision.types import LineImage


@dataclass(frozen=True)
class GrayLines:
    """Brightness on a scale of 0..255, as is the configured noise, and the unusable samples; None where none is."""

    gray: Shaped[Tensor, "lines width"]
    unusable: Bool[Tensor, "lines width"] | None

    @classmethod
    def read(cls, image: LineImage, lines: range, levels: CameraLevels, white: float) -> "GrayLines":
        """Those of some lines; beyond the ends of the image its first and last line stand for all.

        An image that is resampled is so as grey values: one channel of three. What is interpolated from an unusable
        sample is unusable.
        """
        if isinstance(image, ResampledImage):
            return cls._resampled(image, lines, levels, white)
        codes = _read_within(image, lines)
        unusable = levels.unusable(codes)
        return cls(_gray(codes, white), unusable)

    @classmethod
    def _resampled(cls, image: ResampledImage, lines: range, levels: CameraLevels, white: float) -> "GrayLines":
        taken = image.source_lines(lines)
        codes = image.source.read(taken.start, taken.stop)
        bad = levels.unusable(codes)
        brightness = image.resample(_gray(codes, white)[..., None], taken.start, lines)[..., 0]
        return cls(brightness, None if bad is None else image.spread(bad, taken.start, lines))


def _read_within(image: LineImage, lines: range) -> Tensor:
    """Lines of an image; beyond its ends those are repeated."""
    last = image.shape[0] - 1
    start, stop = (min(max(line, 0), last) for line in (lines.start, lines.stop - 1))
    values = image.read(start, stop + 1)
    if len(values) == len(lines):
        return values
    return values[torch.arange(lines.start, lines.stop).clamp(start, stop) - start]


def _gray(image: Tensor, white: float) -> Tensor:
    """Brightness on a scale of 0..255: bytes of byte images, float32 of others."""
    return gray_bytes(image) if image.dtype == torch.uint8 and white == 255.0 else gray(image) * (255.0 / white)
