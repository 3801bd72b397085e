"""Raw images -> images that match as those of a rectified pair do: a point of the object lies on one row of both.

The right image is resampled to the columns of the left one, which is not resampled along its lines: noise that is
interpolated looks like texture. Where both cameras look at one plane, rows are lines. Where not, the rows of both
images run askew through the lines (``Rectification.row_shear``). What was measured is brought back to the lines of the
left camera, and to the columns of its ideal image.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from lsvision.geometry import Rectification
from lsvision.image.resampled import ResampledImage, ShearedRows
from lsvision.image.stereo.clipping import UnusableSamples
from lsvision.image.tiling import in_parallel, tiles
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import StripMatch, disparity_range
from lsvision.types import Depth, LineImage, Scan, StereoPair, Travel

_STEP_PX = 1.0  # between what is interpolated and the nearest disparity, beyond which they are of two surfaces
_REACH_PX = 8  # of a match beside its partner
_TILE = (64, 1024)
_LEAST_MM = 1e-6  # of travel; a shear below that is rounding


@dataclass(frozen=True)
class RectifiedPair:
    """The images of a raw scan as they are matched, resampled where they are read; ``lines`` is the scan's length."""

    left: LineImage
    right: ResampledImage
    rectification: Rectification
    left_rows: ShearedRows
    lines: int

    @classmethod
    def of(cls, scan: Scan, config: DisparityConfig, n: Float[Tensor, "3"] | None = None) -> "RectifiedPair | None":
        """That of a scan; None where its images are rectified, or it has no second one.

        Args:
            n: motion of the object, by which the cameras see it moved between their planes; the nominal one if None.
        """
        rectification = Rectification.of(scan.raw_rig, n)
        if rectification is None or not isinstance(scan.images, StereoPair):
            return None
        low, high = disparity_range(rectification.matched_rig, config)
        shear = rectification.row_shear((float(low), float(high)))
        late = (None, None) if shear is None else (_or_none(shear.left_mm), _or_none(shear.right_mm))
        left_rows = _rows_for(scan.travel, scan.lines, late[0])
        right_rows = ShearedRows(scan.travel, left_rows.rows, left_rows.first, late[1])
        left: LineImage = scan.left if late[0] is None else ResampledImage(scan.left, None, left_rows)
        right = ResampledImage(scan.images.right, rectification.matched_right_columns, right_rows)
        return cls(left, right, rectification, left_rows, scan.lines)

    @property
    def images(self) -> StereoPair:
        """Both images."""
        return StereoPair(self.left, self.right)

    def rows_of(self, start: int, stop: int) -> range:
        """The rows on which the left image shows lines ``start..stop-1``."""
        return range(*self.left_rows.reach((start, stop))) if self.left_rows.late_mm is not None else range(start, stop)

    def without_unseen(self, match: StripMatch, rows: range, shift: int) -> StripMatch:
        """What was matched on some rows, less partners before the right image's first line or after its last.

        Args:
            shift: by how many rows later the right image was read.
        """
        unseen = self.right.outside(range(rows.start + shift, rows.stop + shift))
        if unseen is None:
            return match
        return StripMatch(UnusableSamples(None, unseen).removed_from(match.disparity, 1), match.sigma)

    def depth(self, match: StripMatch, rows: range, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1`` of the ideal left image, from what was matched on their rows.

        Disparities are interpolated between neighbours of one surface; elsewhere the nearest counts.
        """
        columns = self.rectification.matched_columns
        z = match.disparity.new_empty(stop - start, len(columns.places))
        sigma = torch.empty_like(z)
        seen, last = self._seen_by_right(), self.rectification.raw_width - 1

        def fill(tile: tuple[slice, slice]) -> None:
            """Depth of a tile of the ideal image."""
            part = columns.part(tile[1], z)
            first = int(part.places[0])
            wanted = slice(first, int(part.places[-1]) + 2)
            # The shear of a column is that of the nearest one: it changes by less than a hundredth of a line.
            near = part.places.round().long().clamp(0, last)
            row = self.left_rows.rows_after(rows.start, range(start + tile[0].start, start + tile[0].stop), near)
            maps = [at.contiguous().numpy() for at in torch.broadcast_tensors((part.places - first).float(), row)]
            found = _at(match.disparity[:, wanted], maps, cv2.INTER_LINEAR)
            nearest = _at(match.disparity[:, wanted], maps, cv2.INTER_NEAREST)
            one_surface = (found - nearest).abs() <= _STEP_PX  # false beside a hole
            disparity = torch.where(one_surface, found, nearest)
            partner = part.places.to(z) - disparity
            z[tile] = part.depth(disparity).masked_fill_((partner < seen[0]) | (partner > seen[1]), torch.nan)
            sigma[tile] = part.depth_sigma(z[tile], _at(match.sigma[:, wanted], maps, cv2.INTER_NEAREST))

        in_parallel(fill, tiles(stop - start, z.shape[1], _TILE))
        return Depth(z, sigma)

    def _seen_by_right(self) -> tuple[int, int]:
        """First and last column of the matched right image of which the camera sees all that a match reads."""
        columns, last = self.rectification.matched_right_columns, self.rectification.raw_width - 1
        seen = ((columns >= 0) & (columns <= last)).nonzero()[:, 0]
        first, last_seen = int(seen[0]), int(seen[-1])
        return first + _REACH_PX * (first > 0), last_seen - _REACH_PX * (last_seen < last)


def _at(values: Tensor, maps: list[NDArray[np.float32]], interpolation: int) -> Tensor:
    """Values at (column, row), px."""
    column, row = maps
    found = cv2.remap(values.numpy(), column, row, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(found)


def _or_none(late_mm: Tensor) -> Tensor | None:
    return late_mm if float(late_mm.abs().max()) > _LEAST_MM else None


def _rows_for(travel: Travel, lines: int, late_mm: Tensor | None) -> ShearedRows:
    """Rows, from a first one on, that hold every column of all lines of a scan."""
    if late_mm is None:
        return ShearedRows(travel, lines)
    ends = ShearedRows(travel, lines, 0, late_mm).rows_of(torch.tensor([0.0, lines - 1.0], dtype=torch.float64))
    first, last = int(ends.min().floor()), int(ends.max().floor()) + 1
    return ShearedRows(travel, last - first + 1, first, late_mm)
