"""Scan + depth + motion -> product: an orthographic, metric image and height map, strip by strip.

For every cell of a square grid in the product frame the position (u, v) in the scan that saw it is located
(``locate``); colour is sampled there once, height is interpolated between the samples that enclose the cell.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, depth_sigma, depth_step_mm, zero_disparity_mm
from lsvision.image.resampling import SAMPLED_TILES
from lsvision.image.tiling import TILE, in_parallel, tiles
from lsvision.stages.correction.color_lines import color_lines, lines_without_colors, sampling_for
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.grid import plan_product, source_dtype
from lsvision.stages.correction.locate import Locator, SeenCells, cell_spacing
from lsvision.stages.correction.profiles import DepthWithoutLines, ProfileReader, ProfileRule
from lsvision.stages.correction.rig_errors import RigErrors
from lsvision.stages.correction.uncertainty import position_sigma
from lsvision.types import DepthSource, LineMotion, Motion, ProductGrid, ProductStrip, Rig, Scan, missing_ranges

# Lines under a tile, of the 8192 over which ``PIXEL_PARTS`` are exact: slope and relief of the object add to them.
_TILE_LINES = 4096


def correct_scan(
    scan: Scan,
    depth: DepthSource,
    motion: Motion,
    config: CorrectionConfig,
    grid: ProductGrid | None = None,
    line_motion: LineMotion | None = None,
) -> Iterator[ProductStrip]:
    """Rebuild a scan in the product frame, strip by strip, in memory that does not grow with its length.

    Args:
        depth: of the left image: ``depth_of(scan, ..)``.
        grid: cells to fill; ``plan_product`` where it is None.
        line_motion: motion from line to line; None leaves it in the product.
    """
    correction = Correction(scan, depth, motion, config, grid or plan_product(scan, motion, config), line_motion)
    for row in range(0, correction.grid.rows, config.strip_rows):
        yield correction.strip((row, min(row + config.strip_rows, correction.grid.rows)))


def z_range_of(rig: Rig, config: CorrectionConfig) -> tuple[float, float]:
    """Depths, mm, that the heights of a product lie between."""
    z0, (low, high) = zero_disparity_mm(rig), config.height_range_mm
    return z0 - high, z0 - low


def rig_errors_of(scan: Scan, motion: Motion, config: CorrectionConfig) -> RigErrors | None:
    """What is not known of a scan's raw rig, in the heights of its product; None where that counts as exact."""
    return RigErrors.of(scan.raw_rig, scan.rig, motion.n, z_range_of(scan.rig, config))


@dataclass(frozen=True)
class Correction:
    """A scan on its way to a product; rows come out the same whatever strip they are computed in.

    The grid does not depend on the line motion: products with and without it have the same cells. What the motion moves
    beyond its rim is lost.
    """

    scan: Scan
    depth: DepthSource
    motion: Motion
    config: CorrectionConfig
    grid: ProductGrid
    line_motion: LineMotion | None = None

    @cached_property
    def frame(self) -> ProductFrame:
        """The frame of the product."""
        still = self.line_motion is None or self.line_motion.is_still
        return ProductFrame(self.scan.rig, self.scan.travel, self.motion.n, None if still else self.line_motion)

    @cached_property
    def locator(self) -> Locator:
        """Finds what the cells of the product see."""
        rule = ProfileRule(
            columns=self.grid.columns,
            pitch_mm=self.grid.pitch_mm,
            origin_x_mm=self.grid.origin_x_mm,
            z_range_mm=z_range_of(self.scan.rig, self.config),
            largest_step_mm=depth_step_mm(self.scan.rig, self.config.step_px),
            bridge_px=self.config.bridge_px,
        )
        profiles = ProfileReader(self._shown_depth, self.frame, rule, with_sigma=self.config.uncertainty)
        return Locator(self.frame, self.grid, self.config, profiles)

    @cached_property
    def rig_errors(self) -> RigErrors | None:
        """What is not known of a raw rig, in heights."""
        return rig_errors_of(self.scan, self.motion, self.config)

    def strip(self, rows: tuple[int, int]) -> ProductStrip:
        """Rows ``rows[0]..rows[1]-1`` of the product."""
        strip = self._empty_strip(rows)
        lines = self.locator.lines_of(rows, self.scan.lines)
        if len(lines.along) < 2:
            return strip
        self.locator.profiles.load(lines.start, lines.stop)
        sampling = sampling_for(self.config, self.locator.spacing)
        colors = color_lines(self.scan, self.frame, (lines.start, lines.stop), sampling)
        image = self.scan.left.read(*colors.image_range)

        def fill_tile(tile: tuple[slice, slice]) -> None:
            """Locate the cells of a tile and write what they see."""
            tile_rows, columns = tile
            seen = self.locator.locate(lines, (rows[0] + tile_rows.start, rows[0] + tile_rows.stop), columns)
            if seen is not None:
                in_image = colors.in_image(seen.column)
                for part in tiles(len(in_image), in_image.shape[1], SAMPLED_TILES[self.config.resampler]):
                    colors.sample(image, seen.part(*part), in_image[part], strip.color[tile][part])
                self._fill_heights(in_image, seen, strip, tile)

        # Where cells are coarse, fewer rows hold as many lines as a place can be counted through.
        size = min(TILE[0], max(1, int(_TILE_LINES / self.locator.spacing[0]))), TILE[1]
        in_parallel(fill_tile, tiles(rows[1] - rows[0], self.grid.columns, size))
        return strip

    @property
    def _shown_depth(self) -> DepthSource:
        """The depth without the lines whose colours would come from missing lines of the image."""
        if not missing_ranges(self.scan.left):
            return self.depth
        sampling = sampling_for(self.config, cell_spacing(self.frame, self.grid))
        return DepthWithoutLines(self.depth, lines_without_colors(self.scan, self.frame, sampling))

    def _fill_heights(self, in_image: Tensor, seen: SeenCells, strip: ProductStrip, tile: tuple[slice, slice]) -> None:
        """Write everything but the colours of a tile to the strip."""
        height = seen.relief + self.frame.height_over_relief_mm
        strip.valid[tile] = seen.measured
        strip.height[tile] = height.masked_fill_(~seen.measured, torch.nan)
        line = seen.line.to(strip.source.dtype) + seen.first_line
        strip.source[tile][..., 0], strip.source[tile][..., 1] = line, in_image
        if strip.sigma is not None:
            strip.sigma[tile] = self._position_sigma(seen).masked_fill_(~seen.measured[..., None], torch.nan)

    def _position_sigma(self, seen: SeenCells) -> Tensor:
        column, line = seen.column.double(), seen.line.double() + seen.first_line
        sigma, z = seen.depth_sigma, self.frame.depth(column, seen.relief.double(), line)
        if sigma is None:
            sigma = depth_sigma(self.scan.rig, z, self.config.disparity_sigma_px)
        found = position_sigma(self.frame, self.motion.covariance, column, line, sigma, z)
        if self.rig_errors is not None:
            found[..., 2] = found[..., 2].hypot(self.rig_errors.sigma_mm(column, z))
        return found

    def _empty_strip(self, rows: tuple[int, int]) -> ProductStrip:
        shape, left = (rows[1] - rows[0], self.grid.columns), self.scan.left
        return ProductStrip(
            row=rows[0],
            color=torch.zeros(*shape, left.shape[2], dtype=left.dtype),
            height=torch.full(shape, torch.nan),
            valid=torch.zeros(shape, dtype=torch.bool),
            # Plane by plane in memory, as they are filled and as products are stored.
            source=torch.full((2, *shape), torch.nan, dtype=source_dtype(self.scan.lines)).movedim(0, -1),
            sigma=torch.full((3, *shape), torch.nan).movedim(0, -1) if self.config.uncertainty else None,
        )
