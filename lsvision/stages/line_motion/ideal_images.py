"""The images of a raw pair as those of the ideal pair that stands for it, where they show one object.

An ideal column of the right camera sees a point of the object some travel later than the left one does, and beside
where an ideal camera of one plane would. By how much depends on the point's depth: here on that of the object's own
profile, which all lines share. All colours of a camera are late by the same, as all lie as far from green in both.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import Rectification, disparity_at
from lsvision.image.resampled import ResampledImage
from lsvision.image.sheared_rows import ShearedRows
from lsvision.types import Rig, Scan, StereoPair

_STEPS = 4  # of a disparity's search, each of which leaves a hundredth of the error


def ideal_images(
    scan: Scan, rectification: Rectification, column: Float[Tensor, " columns"], z: Float[Tensor, " columns"]
) -> StereoPair:
    """Both images of a raw pair, in the columns of the ideal one and on the lines of the left camera.

    Args:
        column: columns of the ideal left image that show the object, float64, px. z: its depth there, mm.

    Raises:
        ValueError: the scan has no second image.
    """
    if not isinstance(scan.images, StereoPair):
        raise ValueError("expected a scan with two images, got one with a depth map")
    partner = _Partners.of(scan.rig, rectification, column, z).of_line(scan.rig.width_px)
    still, late = ShearedRows(scan.travel, scan.lines), ShearedRows(scan.travel, scan.lines, 0, partner.late_mm)
    return StereoPair(
        ResampledImage(scan.images.left, rectification.raw_left_columns, still),
        ResampledImage(scan.images.right, rectification.raw_column(partner.seen_at, "right"), late),
    )


@dataclass(frozen=True)
class _Partners:
    """Columns of the right image: in an ideal pair of one plane, and of this one, and how much later these see it."""

    column: Float[Tensor, " columns"]
    seen_at: Float[Tensor, " columns"]
    late_mm: Float[Tensor, " columns"]

    @classmethod
    def of(cls, rig: Rig, rectification: Rectification, column: Tensor, z: Tensor) -> "_Partners":
        """Those of columns of the left image that show an object at depths z, mm."""
        expected = disparity_at(rig, z)
        disparity = expected
        for _ in range(_STEPS):
            met = rectification.meet(column, disparity)
            disparity = disparity + expected - disparity_at(rig, met.z)
        return cls(column - expected, column - disparity, rectification.meet(column, disparity).later_mm)

    def of_line(self, width: int) -> "_Partners":
        """The same of all columns of a line: between those of the object, and beside them as at its edges."""
        order, every = self.column.argsort(), np.arange(width, dtype=np.float64)

        def between(values: Tensor) -> Tensor:
            return torch.from_numpy(np.interp(every, self.column[order].numpy(), values[order].numpy()))

        column = torch.from_numpy(every)
        return _Partners(column, column + between(self.seen_at - self.column), between(self.late_mm))
