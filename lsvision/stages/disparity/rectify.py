"""Raw images -> images that match as those of a rectified pair do: a point of the object lies on one row of both.

The right image is resampled to the columns of the left one, which is not resampled along its lines: noise that is
interpolated looks like texture. Where both cameras look at one plane, rows are lines. Where not, the rows of both
images run askew through the lines (``Rectification.row_shear``). What was measured is brought back to the lines of the
left camera, and to the columns of its ideal image.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import Rectification
from lsvision.image.resampled import ResampledImage
from lsvision.image.sheared_rows import ShearedRows
from lsvision.image.stereo.clipping import UnusableSamples
from lsvision.image.stereo.coarse_to_fine import COARSEST
from lsvision.image.tiling import in_parallel, tiles
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.ideal_lines import IdealLines
from lsvision.stages.disparity.match import StripMatch, disparity_range
from lsvision.types import Depth, Scan, StereoPair, Travel

_STEP_PX = 1.0  # between what is interpolated and the nearest disparity, beyond which they are of two surfaces
_REACH_PX, _BESIDE_PX = 8, 32  # of a match beside its partner; of the search
_TILE = (64, 1024)
_LEAST_MM = 1e-6  # of travel; a shear below that is rounding


@dataclass(frozen=True)
class RectifiedPair:
    """The images of a raw scan as they are matched, resampled where they are read.

    Attributes:
        columns: of the raw left image, that may have partners: those of both images. lines: of the scan.
        reach_px: lowest and highest disparity.
    """

    left: ResampledImage
    right: ResampledImage
    rectification: Rectification
    columns: slice
    lines: int
    reach_px: tuple[int, int]

    @classmethod
    def of(cls, scan: Scan, config: DisparityConfig, n: Float[Tensor, "3"] | None = None) -> "RectifiedPair | None":
        """That of a scan; None where its images are rectified, or it has no second one.

        Args:
            n: motion of the object, by which the cameras see it moved between their planes; the nominal one if None.
        """
        rectification = Rectification.of(scan.raw_rig, n)
        if rectification is None or not isinstance(scan.images, StereoPair):
            return None
        reach_px = disparity_range(rectification.matched_rig, config)
        columns = _columns_in_reach(rectification, reach_px)
        shear = rectification.row_shear((float(reach_px[0]), float(reach_px[1])))
        late = (None, None) if shear is None else (shear.left_mm[columns], shear.right_mm[columns])
        left_rows = _rows_for(scan.travel, scan.lines, _or_none(late[0]))
        right_rows = ShearedRows(scan.travel, left_rows.rows, left_rows.first, _or_none(late[1]))
        left = ResampledImage(scan.left, columns, left_rows)
        right = ResampledImage(scan.images.right, rectification.matched_right_columns[columns], right_rows)
        return cls(left, right, rectification, columns, scan.lines, reach_px)

    @property
    def images(self) -> StereoPair:
        """Both images."""
        return StereoPair(self.left, self.right)

    def rows_of(self, start: int, stop: int) -> range:
        """The rows on which the left image shows lines ``start..stop-1``."""
        return range(start, stop) if self.left.rows.late_mm is None else range(*self.left.rows.reach((start, stop)))

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
        columns, lines = self.rectification.matched_columns, self._ideal_lines
        match = StripMatch(match.disparity.contiguous(), match.sigma.contiguous())
        z = match.disparity.new_empty(stop - start, len(columns.places))
        sigma = torch.empty_like(z)

        def fill(tile: tuple[slice, slice]) -> None:
            """Depth of a tile of the ideal image."""
            part, own = columns.part(tile[1], z), range(start + tile[0].start, start + tile[0].stop)
            at = lines.sampled(match, rows.start, own, tile[1])
            one_surface = (at.between - at.nearest).abs_() <= _STEP_PX  # false beside a hole
            disparity = torch.where(one_surface, at.between, at.nearest)
            self._drop_unseen(disparity, part.places)
            z[tile] = part.depth(disparity)
            sigma[tile] = part.depth_sigma(z[tile], at.sigma)

        in_parallel(fill, tiles(len(z), z.shape[1], _TILE))
        return Depth(z, sigma)

    def _drop_unseen(self, disparity: Tensor, places: Tensor) -> None:
        """Leave out disparities at places of a line whose partners lie beside what the right camera sees."""
        first, last = self._seen_by_right
        low, high = self.reach_px
        if float(places[0]) - high - _REACH_PX < first or float(places[-1]) - low + _REACH_PX > last:
            partner = places.to(disparity) - disparity
            disparity.masked_fill_((partner < first) | (partner > last), torch.nan)

    @cached_property
    def _ideal_lines(self) -> IdealLines:
        places = self.rectification.matched_columns.places - self.columns.start
        return IdealLines(places, self.left.shape[1], self.left.rows)

    @cached_property
    def _seen_by_right(self) -> tuple[int, int]:
        """First and last column of the matched right image of which the camera sees all that a match reads."""
        first, last = _seen_by_right(self.rectification)
        end = self.rectification.raw_width - 1
        return first + _REACH_PX * (first > 0), last - _REACH_PX * (last < end)


def _seen_by_right(rectification: Rectification) -> tuple[int, int]:
    """First and last column of the raw left image along whose ideal column the right camera sees."""
    columns = rectification.matched_right_columns
    seen = ((columns >= 0) & (columns <= rectification.raw_width - 1)).nonzero()[:, 0]
    return int(seen[0]), int(seen[-1])


def _columns_in_reach(rectification: Rectification, reach_px: tuple[int, int]) -> slice:
    """Columns of the raw left image that may have partners, and some beside them that windows read.

    Both ends lie at multiples of what images are reduced by, or at those of the line.
    """
    first, last = _seen_by_right(rectification)
    start, stop = first + reach_px[0] - _BESIDE_PX, last + reach_px[1] + _BESIDE_PX + 1
    return slice(max(start - start % COARSEST, 0), min(stop + -stop % COARSEST, rectification.raw_width))


def _or_none(late_mm: Tensor | None) -> Tensor | None:
    return late_mm if late_mm is not None and float(late_mm.abs().max()) > _LEAST_MM else None


def _rows_for(travel: Travel, lines: int, late_mm: Tensor | None) -> ShearedRows:
    """Rows, from a first one on, that hold every column of all lines of a scan."""
    if late_mm is None:
        return ShearedRows(travel, lines)
    ends = ShearedRows(travel, lines, 0, late_mm).rows_of(torch.tensor([0.0, lines - 1.0], dtype=torch.float64))
    first, last = int(ends.min().floor()), int(ends.max().floor()) + 1
    return ShearedRows(travel, last - first + 1, first, late_mm)
