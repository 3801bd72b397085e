"""Whether both cameras see the corners of a board on the same lines."""

import math
from dataclasses import dataclass

from torch import Tensor

from lsvision.types import BoardCorners

_FEWEST = 12  # corners
_SURE = 5.0  # standard deviations
_LEAST_LINES = 0.25  # less comes from a rectification that is not perfect
_NORMAL_MEDIAN = 1.2533  # standard deviation of a median over that of a mean


@dataclass(frozen=True)
class RowDifference:
    """Line of the right image less that of the left one, the median over corners, and its standard deviation."""

    lines: float
    sigma: float

    @classmethod
    def of(cls, difference: Tensor) -> "RowDifference":
        """That of corners, ``(corners,)`` lines; nothing is known of fewer than twelve."""
        if len(difference) < _FEWEST:
            return cls(math.nan, math.inf)
        median = difference.median()
        spread = (difference - median).abs().median() / 0.6745
        return cls(float(median), float(spread) * _NORMAL_MEDIAN / len(difference) ** 0.5)

    @property
    def is_systematic(self) -> bool:
        """Whether it is more than noise and more than a rectification leaves."""
        return abs(self.lines) > max(_LEAST_LINES, _SURE * self.sigma)


def row_difference(corners: BoardCorners) -> RowDifference | None:
    """Row difference of the corners of a board; None where a depth map replaces the right image."""
    if corners.right_px is None:
        return None
    difference = (corners.right_px - corners.left_px)[corners.valid, 1]
    return RowDifference.of(difference)
