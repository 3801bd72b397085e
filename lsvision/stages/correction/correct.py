"""Scan + depth + Calibration -> Products: an orthographic, metric image and height map, strip by strip.

For every cell of a square grid in the product frame the position (u, v) in the scan that saw it is found in two
one-dimensional steps, along each line (``profiles``) and then across the lines, because q_x and q_z of a sample depend
on its own line alone. Colour is sampled there; height is interpolated between the samples that enclose the cell.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import line_at, product_axes, travel_at
from lsvision.image.resampling import SAMPLED_TILES
from lsvision.image.tiling import TILE, in_parallel, tiles
from lsvision.image.visibility import Seen, Surface, see_cells
from lsvision.stages.correction.color_lines import ColorLines, color_lines
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.correction.profiles import ProfileReader, ProfileRule
from lsvision.stages.correction.uncertainty import position_sigma
from lsvision.types import LineImage, Motion, ProductGrid, ProductStrip, Scan

# Lines missing between two from which on nothing counts as measured there; a camera that runs free misses a few.
_MISSED_LINES = 3
# Lines under a tile, of the 8192 over which ``PIXEL_PARTS`` are exact: slope and relief of the object add to them.
_TILE_LINES = 4096


def correct_scan(
    scan: Scan,
    depth: LineImage,
    motion: Motion,
    config: CorrectionConfig,
    grid: ProductGrid | None = None,
    depth_sigma: LineImage | None = None,
) -> Iterator[ProductStrip]:
    """Rebuild a scan in the product frame, one strip of rows after the other, in memory that does not grow with it.

    Args:
        depth: z of the left image's samples, mm, NaN for none: the scan's own or ``MatchedDepth``.
        grid: cells to fill; ``plan_product`` where it is None.
        depth_sigma: standard deviation of z, mm, sample by sample, where the matcher tells it.
    """
    correction = _Correction.of(scan, depth, motion, config, grid or plan_product(scan, motion, config), depth_sigma)
    for row in range(0, correction.grid.rows, config.strip_rows):
        yield _correct_rows(correction, (row, min(row + config.strip_rows, correction.grid.rows)))


def correct_rows(
    scan: Scan,
    depth: LineImage,
    motion: Motion,
    config: CorrectionConfig,
    grid: ProductGrid,
    rows: tuple[int, int],
    depth_sigma: LineImage | None = None,
) -> ProductStrip:
    """Rows ``rows[0]..rows[1]-1`` of a product; the same whatever strip they are computed in."""
    return _correct_rows(_Correction.of(scan, depth, motion, config, grid, depth_sigma), rows)


@dataclass(frozen=True)
class _Correction:
    """A scan on its way to a product."""

    scan: Scan
    motion: Motion
    config: CorrectionConfig
    grid: ProductGrid
    profiles: ProfileReader
    axes: Tensor
    largest_step_mm: float

    @classmethod
    def of(
        cls,
        scan: Scan,
        depth: LineImage,
        motion: Motion,
        config: CorrectionConfig,
        grid: ProductGrid,
        depth_sigma: LineImage | None,
    ) -> "_Correction":
        """From what ``correct_scan`` takes."""
        rig = scan.rig
        step = config.step_px * rig.zero_disparity_mm**2 / (rig.focal_length_px * rig.baseline_mm)
        low, high = config.height_range_mm
        z_range = (rig.zero_disparity_mm - high, rig.zero_disparity_mm - low)
        rule = ProfileRule(grid.columns, grid.pitch_mm, grid.origin_x_mm, z_range, step, config.bridge_px)
        reader = ProfileReader(depth, depth_sigma if config.uncertainty else None, rig, motion, rule)
        return cls(scan, motion, config, grid, reader, product_axes(motion.n), step)

    def q_x(self, columns: slice) -> Tensor:
        return self.grid.origin_x_mm + self.grid.pitch_mm * torch.arange(columns.start, columns.stop).double()

    def offset_range(self, columns: slice) -> tuple[float, float]:
        """Least and greatest part of q_y, mm, that comes from the place across the line, over some columns."""
        q_x = self.q_x(columns)[[0, -1]]
        z = self.scan.rig.zero_disparity_mm - torch.tensor(self.config.height_range_mm, dtype=torch.float64)
        x = (q_x[:, None] - z * self.axes[0, 2]) / self.axes[0, 0]
        offset = x * self.axes[1, 0] + z * self.axes[1, 2]
        return float(offset.min()), float(offset.max())


@dataclass(frozen=True)
class _Lines:
    """Consecutive scan lines from ``start`` on: how far along q_y each lies, mm, and where its colours were taken."""

    start: int
    along: Tensor
    colors: ColorLines

    def between(self, low: float, high: float) -> tuple[int, int]:
        """Range of the lines that reach from low to high, mm, with one more at either end."""
        backwards = bool(self.along[0] > self.along[-1])
        ascending = self.along.flip(0) if backwards else self.along
        bounds = torch.tensor([low, high], dtype=torch.float64)
        first, last = torch.searchsorted(ascending, bounds).tolist()
        first, last = max(first - 2, 0), min(last + 2, len(ascending))
        if backwards:
            first, last = len(ascending) - last, len(ascending) - first
        return self.start + first, self.start + last


def _correct_rows(correction: _Correction, rows: tuple[int, int]) -> ProductStrip:
    strip = _empty_strip(correction, rows)
    start, stop = _lines_for_rows(correction, rows)
    if stop - start < 2:
        return strip
    scan, motion = correction.scan, correction.motion
    correction.profiles.load(start, stop)
    along = torch.linalg.vector_norm(motion.n) * travel_at(scan.travel, torch.arange(start, stop).double())
    lines = _Lines(start, along, color_lines(scan, motion, (start, stop), _spacing(correction)))
    image = scan.left.read(*lines.colors.image_range)

    def fill(tile: tuple[slice, slice]) -> None:
        """Put what a tile sees into the strip."""
        seen = _locate(correction, lines, rows[0], *tile)
        if seen is None:
            return
        color = strip.color[tile]
        for part in tiles(len(color), color.shape[1], SAMPLED_TILES[correction.config.resampler]):
            at = seen.first_line, seen.line[part], seen.column[part], seen.height[part]
            lines.colors.sample(image, *at, correction.config, color[part])
        strip.valid[tile] = seen.measured
        strip.height[tile] = seen.height.masked_fill(~seen.measured, torch.nan)
        strip.source[tile][..., 0], strip.source[tile][..., 1] = seen.line + seen.first_line, seen.column
        if strip.sigma is not None:
            line, column = seen.line.double() + seen.first_line, seen.column.double()
            q_z = scan.rig.zero_disparity_mm - seen.height.double()
            sigma = position_sigma(scan, motion, line, column, q_z, correction.config.disparity_sigma_px, seen.sigma)
            strip.sigma[tile] = sigma.masked_fill_(~seen.measured[..., None], torch.nan)

    # Where cells are coarse, fewer rows hold as many lines as a place can be counted through.
    size = min(TILE[0], max(1, int(_TILE_LINES / _spacing(correction)[0]))), TILE[1]
    in_parallel(fill, tiles(rows[1] - rows[0], correction.grid.columns, size))
    return strip


@dataclass(frozen=True)
class _SeenCells:
    """What the cells of a tile see: place in the scan, counted from ``first_line``, and height, mm."""

    first_line: int
    line: Tensor
    column: Tensor
    height: Tensor
    measured: Tensor
    sigma: Tensor | None


def _locate(correction: _Correction, lines: _Lines, row: int, rows: slice, columns: slice) -> _SeenCells | None:
    """What the cells of a tile see, along each column of the product; None where no line reaches."""
    low, high = correction.offset_range(columns)
    first_row, last_row = row + rows.start, row + rows.stop - 1
    q_y = [correction.grid.origin_y_mm + correction.grid.pitch_mm * at for at in (first_row, last_row)]
    start, stop = lines.between(q_y[0] - high, q_y[1] - low)
    if stop - start < 2:
        return None
    along = lines.along[start - lines.start : stop - lines.start]
    profiles = correction.profiles.read((start, stop), columns)
    backwards = correction.scan.travel.transport == "reverse"
    if backwards:  # in the order of growing q_y
        along, profiles = along.flip(0), Seen.of([values.flip(0) for values in profiles.tensors()])
    seen = see_cells(_surface(correction, along, profiles, first_row, columns), rows.stop - rows.start, dim=0)
    return _SeenCells(
        first_line=start,
        line=(stop - 1 - start) - seen.place if backwards else seen.place,
        column=seen.carried[0],
        height=seen.height,
        measured=seen.measured,
        sigma=seen.carried[1] if profiles.carried else None,
    )


def _surface(correction: _Correction, along: Tensor, profiles: Seen, row: int, columns: slice) -> Surface:
    """Profiles, ``along`` of which is where their lines lie, mm, as a surface over the rows from ``row`` on."""
    grid, axes = correction.grid, correction.axes
    # By Y = q_x axes[0, 1] + q_y axes[1, 1] + q_z axes[2, 1], with q_z = zero disparity - height.
    across = correction.q_x(slice(0, grid.columns)) * (axes[0, 1] / axes[1, 1])
    across = across + correction.scan.rig.zero_disparity_mm * (axes[2, 1] / axes[1, 1])
    base = _snapped((along - across[0] - grid.origin_y_mm) / grid.pitch_mm)
    shift = _snapped((across[0] - across[columns]) / grid.pitch_mm).float()
    part = torch.add((base - base.floor()).float()[:, None], shift)
    missed = _missed_lines(correction, along)[:, None]
    return Surface(
        whole=(base.floor() - row).float(),
        part=part.add_(profiles.height, alpha=float(axes[2, 1] / (axes[1, 1] * grid.pitch_mm))),
        height=profiles.height,
        carried=(profiles.place, *profiles.carried),
        connected=(profiles.height.diff(dim=0).abs_() <= correction.largest_step_mm)  # false beside a hole
        .logical_and_(missed <= correction.config.bridge_px),
        measured=(profiles.measured[1:] & profiles.measured[:-1]).logical_and_(missed <= _MISSED_LINES),
    )


def _snapped(cells: Tensor) -> Tensor:
    """Positions to a millionth of a cell, so that lines of equal travel stay at one place."""
    return (cells * 2**20).round() / 2**20


def _missed_lines(correction: _Correction, along: Tensor) -> Tensor:
    """Lines that would have fitted between each two, by how far the object moved on."""
    return along.diff() / (correction.motion.stretch * correction.scan.travel.line_pitch_mm) - 1


def _spacing(correction: _Correction) -> tuple[float, float]:
    """Distance of neighbouring cells in the scan, in lines and in columns."""
    scan, pitch = correction.scan, correction.grid.pitch_mm
    return pitch / (correction.motion.stretch * scan.travel.line_pitch_mm), pitch / scan.rig.object_pitch_mm


def _lines_for_rows(correction: _Correction, rows: tuple[int, int]) -> tuple[int, int]:
    """Range of scan lines that rows of the product can come from, with some to spare."""
    grid = correction.grid
    low, high = correction.offset_range(slice(0, grid.columns))
    q_y = torch.tensor([rows[0], rows[1] - 1], dtype=torch.float64) * grid.pitch_mm + grid.origin_y_mm
    reach = torch.cat([q_y - low, q_y - high]) / torch.linalg.vector_norm(correction.motion.n)
    line = line_at(correction.scan.travel, reach)
    start, stop = math.floor(float(line.min())) - 2, math.ceil(float(line.max())) + 3
    return max(start, 0), min(stop, correction.scan.lines)


def _empty_strip(correction: _Correction, rows: tuple[int, int]) -> ProductStrip:
    shape, left = (rows[1] - rows[0], correction.grid.columns), correction.scan.left
    return ProductStrip(
        row=rows[0],
        color=torch.zeros(*shape, left.shape[2], dtype=left.dtype),
        height=torch.full(shape, torch.nan),
        valid=torch.zeros(shape, dtype=torch.bool),
        # Plane by plane in memory, as they are filled and as products are stored.
        source=torch.full((2, *shape), torch.nan).movedim(0, -1),
        sigma=torch.full((3, *shape), torch.nan).movedim(0, -1) if correction.config.uncertainty else None,
    )
