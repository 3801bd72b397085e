"""What the codes of a pair of line cameras mean: white, saturation, and columns that are at fault.

All of it is read from a few lines at fixed places, so that every strip of a scan is read alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Shaped
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.brightness import gray, sampled_lines, white_level
from lsvision.types import LineImage, StereoPair

_NO_CODE = 2**32
_DEPTHS = (10, 12, 14, 16)  # bits of sensors whose images have sixteen
_HOT_SHARE = 2e-4  # of the samples may lie above a plateau: hot pixels
_PLATEAU_SHARE, _PLATEAU_RISE, _PLATEAU_BELOW = 1e-3, 2.0, 3  # of the samples; over the most frequent code just below
_GROUP = 16  # neighbouring columns, by which the variation of one of them is judged
# Shares of the usual range along the scan, which must be at least 3 codes. A column counts as stuck only where the
# columns on both sides vary: at the edge of a dark area the range changes from column to column.
_STUCK, _LIVELY, _LEAST_RANGE = 0.1, 0.5, 3.0
_WILD, _LEAST_DIFFERENCE = 8.0, 0.02  # times the usual difference from a neighbour; of white
# Share of the lines on which a column is above or below those on both sides of it: 2/3 where all is noise.
_STANDS_OUT = 0.5


@dataclass(frozen=True)
class CameraLevels:
    """Saturation and faults of one line camera.

    Attributes:
        plateau: from this code on samples are saturated.
        tops: codes that are saturated by themselves: the largest ones of the sensors that the image may come from.
        faulty: columns that are stuck at a value, or vary with something else than the object.
    """

    plateau: int
    tops: tuple[int, ...]
    faulty: Bool[Tensor, " width"]

    @classmethod
    def of(cls, image: LineImage, white: float) -> "CameraLevels":
        """Read the levels of an image.

        Args:
            white: the ``white_level`` of the scan.
        """
        sampled = sampled_lines(image)
        faulty = _faulty_columns(sampled, white)
        if not image.dtype.is_floating_point:
            codes = sampled[:, ~faulty, _deciding_channel(sampled)].flatten().to(torch.int64)
            counts = codes.bincount()
            # The highest code but for the few of hot pixels.
            highest = int((counts.cumsum(0) < len(codes) - int(_HOT_SHARE * len(codes))).sum())
            plateau = highest if _is_plateau(counts, highest) else torch.iinfo(image.dtype).max
            return cls(plateau, _top_codes(image.dtype, highest), faulty)
        return cls(_NO_CODE, (), faulty)

    def unusable(self, lines: Shaped[Tensor, "lines width channels"]) -> Bool[Tensor, "lines width"] | None:
        """Which samples are saturated or from a faulty column; None where none is. Green decides for all colours."""
        saturated = self._saturated(cv2.extractChannel(lines.numpy(), _deciding_channel(lines)))
        if saturated is None and not bool(self.faulty.any()):
            return None
        faulty = self.faulty.expand(lines.shape[:2])
        return faulty.contiguous() if saturated is None else torch.from_numpy(saturated) | faulty

    def saturated(self, lines: Shaped[Tensor, "lines width channels"]) -> Bool[Tensor, "lines width channels"] | None:
        """Which samples are saturated, each colour by itself; None where none is."""
        saturated = self._saturated(lines.numpy())
        return None if saturated is None else torch.from_numpy(saturated)

    def _saturated(self, codes: NDArray) -> NDArray[np.bool_] | None:
        if codes.size == 0 or codes.max() < min(self.plateau, *self.tops, _NO_CODE):
            return None
        bad: NDArray[np.bool_] = codes >= min(self.plateau, np.iinfo(codes.dtype).max)
        for top in self.tops:
            bad |= codes == top
        return bad


@dataclass(frozen=True)
class PairLevels:
    """Levels of a scan's two cameras, of the images as they took them; ``white`` is what becomes 255 in both."""

    white: float
    left: CameraLevels
    right: CameraLevels

    @classmethod
    def of(cls, pair: StereoPair) -> "PairLevels":
        """Read the levels of both images."""
        left, right = (as_taken(image) for image in (pair.left, pair.right))
        white = white_level(left, right)
        return cls(white, CameraLevels.of(left, white), CameraLevels.of(right, white))


def as_taken(image: LineImage) -> LineImage:
    """An image as the camera delivered it: of codes that were interpolated or divided by a gain nothing can be read."""
    source: LineImage | None = getattr(image, "source", None)
    return image if source is None else as_taken(source)


def _deciding_channel(values: Shaped[Tensor, "lines width channels"]) -> int:
    """The channel whose saturation decides: green, of which brightness is mostly made, or the only one."""
    return min(1, values.shape[-1] - 1)


def _is_plateau(counts: Tensor, highest: int) -> bool:
    """Whether samples, counted by code, pile up at the highest one, as where it stands for everything brighter."""
    if not 0 < highest < len(counts):
        return False
    piled, below = int(counts[highest]), int(counts[max(highest - _PLATEAU_BELOW, 0) : highest].max())
    return piled >= _PLATEAU_SHARE * int(counts.sum()) and piled > _PLATEAU_RISE * below and below > 0


def _top_codes(dtype: torch.dtype, highest: int) -> tuple[int, ...]:
    """The largest codes of sensors whose range holds the highest of some codes, right- or left-aligned."""
    if dtype == torch.uint8:
        return ()
    largest = [2**bits - 1 for bits in _DEPTHS] + [(2**bits - 1) << (16 - bits) for bits in _DEPTHS]
    return tuple(sorted({code for code in largest if code >= highest}))


def _faulty_columns(sampled: Float[Tensor, "lines width channels"], white: float) -> Bool[Tensor, " width"]:
    """Columns that do not vary along the scan although their neighbours do, or differ from both of them far more.

    The median over the sampled lines is what counts: an edge of the object that crosses a column is no fault. Nor is
    one that runs along a column: what lies on an edge is between the columns on both sides of it.
    """
    values = gray(sampled)
    ranges = values.amax(0) - values.amin(0)
    usual_range = _usual(ranges)
    stuck = (ranges <= _STUCK * usual_range) & (usual_range >= _LEAST_RANGE) & _between(ranges > _LIVELY * usual_range)
    steps = F.pad(_median_of_lines(values.diff(dim=1).abs()), (1, 1), value=torch.inf)
    difference = torch.minimum(steps[:-1], steps[1:])  # from the nearer neighbour
    wild = (difference > _WILD * _usual(difference, around=True)) & (difference > _LEAST_DIFFERENCE * white)
    return _standing_out(values, stuck | wild)


def _standing_out(values: Float[Tensor, "lines columns"], odd: Bool[Tensor, " columns"]) -> Bool[Tensor, " columns"]:
    """The odd columns that do not lie between the nearest others on their left and on their right, as an edge does."""
    columns, others = odd.nonzero()[:, 0], (~odd).nonzero()[:, 0]
    after = torch.searchsorted(others, columns)
    inside = (after > 0) & (after < len(others))
    columns, after = columns[inside], after[inside]
    own, left, right = values[:, columns], values[:, others[after - 1]], values[:, others[after]]
    kept = odd.clone()
    kept[columns] = ((own - left) * (own - right) > 0).float().mean(0) > _STANDS_OUT
    return kept


def _median_of_lines(values: Float[Tensor, "lines columns"]) -> Float[Tensor, " columns"]:
    """The lower median of each column: NumPy's partition takes a quarter of the time of torch's median."""
    middle = (len(values) - 1) // 2
    return torch.from_numpy(np.partition(values.numpy(), middle, axis=0)[middle])


def _between(marked: Bool[Tensor, " width"]) -> Bool[Tensor, " width"]:
    """Columns with a marked one, or the line's end, among the two on their left and among the two on their right."""
    ended = F.pad(marked, (2, 2), value=True)
    return (ended[:-4] | ended[1:-3]) & (ended[3:-1] | ended[4:])


def _usual(values: Float[Tensor, " width"], *, around: bool = False) -> Float[Tensor, " width"]:
    """Median of the group of neighbouring columns that each belongs to; the largest of three groups ``around`` it."""
    width = len(values)
    groups = F.pad(values, (0, -width % _GROUP), value=torch.nan).view(-1, _GROUP).nanmedian(-1).values
    if around:
        groups = F.max_pool1d(groups[None], 3, 1, 1)[0]
    return groups.repeat_interleave(_GROUP)[:width]
