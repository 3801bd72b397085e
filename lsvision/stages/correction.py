"""Scan + depth + Calibration -> Products: an orthographic, metric image and height map, strip by strip.

For every cell of a square grid in the product frame the position (u, v) in the scan that saw it is found in two
one-dimensional steps, along each line and then across the lines, because q_x and q_z of a sample depend on its own line
alone. Colour is sampled there; height is interpolated between the samples that enclose the cell.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.geometry import line_at, product_axes, travel_at
from lsvision.image.resampling import Interpolation, sample_image
from lsvision.image.visibility import both_ends, bridge_gaps, interpolate_segments, visible_segments
from lsvision.types import LineImage, Motion, Rig, Scan


@dataclass(frozen=True)
class CorrectionConfig:
    """How a scan becomes a product.

    ``pitch_mm`` is the side of a product's cell; the scan's own line pitch where it is None. ``strip_rows`` are
    computed at once. A surface counts as continuous between neighbours whose disparities differ by at most ``step_px``:
    at one pixel it is so steep that one of the cameras no longer sees it. Holes of up to ``bridge_px`` samples are
    bridged for colour; their height stays invalid. ``height_range_mm`` bounds what a strip looks for; it costs nothing
    to be wide.
    """

    pitch_mm: float | None = None
    interpolation: Interpolation = "bicubic"
    strip_rows: int = 512
    step_px: float = 1.0
    bridge_px: int = 32
    height_range_mm: tuple[float, float] = (-60.0, 60.0)


@dataclass(frozen=True)
class ProductGrid:
    """Cells of a product: cell (row, column) lies at q_y = origin_y + row·pitch, q_x = origin_x + column·pitch, mm."""

    rows: int
    columns: int
    pitch_mm: float
    origin_y_mm: float
    origin_x_mm: float


@dataclass(frozen=True)
class ProductStrip:
    """Consecutive rows of a product.

    ``color (rows, columns, channels)`` in the scan's dtype, ``height (rows, columns)`` float32 mm over the plane of
    zero disparity, NaN where not measured, ``valid`` where it is, ``source (rows, columns, 2)`` float32 (line, column)
    that the colour came from, NaN where nothing was seen.
    """

    row: int
    color: Tensor
    height: Tensor
    valid: Tensor
    source: Tensor


def plan_product(scan: Scan, motion: Motion, config: CorrectionConfig) -> ProductGrid:
    """Grid that holds everything of a scan: the whole field at every depth of the range, from first to last line.

    Raises:
        ConfigError: the pitch is not positive.
    """
    pitch = config.pitch_mm if config.pitch_mm is not None else abs(scan.travel.line_pitch_mm)
    if not (pitch > 0 and math.isfinite(pitch)):
        raise ConfigError(f"correction.pitch_mm must be positive, got {pitch}")
    q_x, _ = _across(*_field(scan.rig, config), product_axes(motion.n))
    low_y, high_y = _travel_range(scan, motion, config)
    return ProductGrid(
        rows=math.floor((high_y - low_y) / pitch) + 1,
        columns=math.floor(float(q_x.max() - q_x.min()) / pitch) + 1,
        pitch_mm=pitch,
        origin_y_mm=low_y,
        origin_x_mm=float(q_x.min()),
    )


def correct_scan(
    scan: Scan, depth: LineImage, motion: Motion, config: CorrectionConfig, grid: ProductGrid | None = None
) -> Iterator[ProductStrip]:
    """Rebuild a scan in the product frame, one strip of rows after the other, in memory that does not grow with it.

    Args:
        depth: z of the left image's samples, mm, NaN for none: the scan's own or ``MatchedDepth``.
        grid: cells to fill; ``plan_product`` where it is None.
    """
    grid = grid or plan_product(scan, motion, config)
    for row in range(0, grid.rows, config.strip_rows):
        yield correct_rows(scan, depth, motion, config, grid, (row, min(row + config.strip_rows, grid.rows)))


def correct_rows(
    scan: Scan, depth: LineImage, motion: Motion, config: CorrectionConfig, grid: ProductGrid, rows: tuple[int, int]
) -> ProductStrip:
    """Rows ``rows[0]..rows[1]-1`` of a product; the same whatever strip they are computed in."""
    start, stop = _lines_for_rows(scan, motion, config, grid, rows)
    if stop - start < 2:
        return _empty_strip(scan, grid, rows)
    z = depth.read(start, stop)[..., 0].to(torch.float64)
    column, line, q_z, measured = _locate(z, scan, motion, config, grid, rows, start)
    seen = torch.isfinite(column)
    color = sample_image(scan.left.read(start, stop), column, line - start, config.interpolation)
    height = torch.where(seen & measured, scan.rig.zero_disparity_mm - q_z, torch.nan)
    return ProductStrip(
        row=rows[0],
        color=color,
        height=height.to(torch.float32),
        valid=seen & measured,
        source=torch.stack([line, column], dim=-1).to(torch.float32),
    )


def _locate(
    z: Tensor,
    scan: Scan,
    motion: Motion,
    config: CorrectionConfig,
    grid: ProductGrid,
    rows: tuple[int, int],
    start: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Column, line and q_z, ``(rows, columns)`` float64, of the surface each cell sees, and whether it was measured."""
    rig, axes = scan.rig, product_axes(motion.n)
    limit = config.step_px * rig.zero_disparity_mm**2 / (rig.focal_length_px * rig.baseline_mm)
    measured = torch.isfinite(z)
    z = bridge_gaps(z, longest=config.bridge_px, largest_step=limit)
    u = torch.arange(z.shape[1], dtype=torch.float64)
    q_x, q_z = _across((u - rig.principal_left_px) / rig.focal_length_px * z, z, axes)

    connected = (z.diff(dim=1).abs() <= limit) & torch.isfinite(z.diff(dim=1))
    segment, fraction = visible_segments((q_x - grid.origin_x_mm) / grid.pitch_mm, q_z, connected, grid.columns)
    column = torch.where(segment >= 0, segment + fraction, torch.nan)
    measured, q_z = both_ends(measured, segment), interpolate_segments(q_z, segment, fraction)

    # Along a column of the product. Lines in the order of growing q_y: backwards for a reversed transport.
    q_x = grid.origin_x_mm + grid.pitch_mm * torch.arange(grid.columns, dtype=torch.float64)
    line = torch.arange(start, start + z.shape[0], dtype=torch.float64)
    along = torch.linalg.vector_norm(motion.n) * travel_at(scan.travel, line)
    q_y = along[:, None] - (q_x * axes[0, 1] + q_z * axes[2, 1]) / axes[1, 1]
    backwards = scan.travel.transport == "reverse"
    by_column = [(t.flip(0) if backwards else t).mT.contiguous() for t in (q_y, q_z, column, measured)]
    q_y, q_z, column, measured = by_column
    connected = (q_z.diff(dim=1).abs() <= limit) & torch.isfinite(q_z.diff(dim=1))
    # Whole rows and lines are taken off and put on without rounding: no bit of a row depends on the strip it lies in.
    position = (q_y - grid.origin_y_mm) / grid.pitch_mm - rows[0]
    segment, fraction = visible_segments(position, q_z, connected, rows[1] - rows[0])
    column, q_z = (interpolate_segments(values, segment, fraction) for values in (column, q_z))
    line = (line[-1] - segment) - fraction if backwards else (line[0] + segment) + fraction
    line = torch.where(segment >= 0, line, torch.nan)
    return column.mT, line.mT, q_z.mT, both_ends(measured, segment).mT


def _across(x: Tensor, z: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """(q_x, q_z), mm, of (x, z): they do not depend on the travel."""
    return x * axes[0, 0] + z * axes[0, 2], x * axes[2, 0] + z * axes[2, 2]


def _field(rig: Rig, config: CorrectionConfig) -> tuple[Tensor, Tensor]:
    """(x, z), mm, of the four corners of the left camera's field over the range of heights."""
    low, high = config.height_range_mm
    z = rig.zero_disparity_mm - torch.tensor([low, low, high, high], dtype=torch.float64)
    u = torch.tensor([0.0, rig.width_px - 1.0] * 2, dtype=torch.float64)
    return (u - rig.principal_left_px) / rig.focal_length_px * z, z


def _skew(scan: Scan, motion: Motion, config: CorrectionConfig) -> tuple[float, float]:
    """Least and greatest part of q_y, mm, that comes from the place across the line: the halo of a strip."""
    x, z = _field(scan.rig, config)
    e_y = product_axes(motion.n)[1]
    offset = x * e_y[0] + z * e_y[2]
    return float(offset.min()), float(offset.max())


def _travel_range(scan: Scan, motion: Motion, config: CorrectionConfig) -> tuple[float, float]:
    low, high = _skew(scan, motion, config)
    ends = torch.linalg.vector_norm(motion.n) * travel_at(scan.travel, torch.tensor([0.0, scan.lines - 1.0]).double())
    return float(ends.min()) + low, float(ends.max()) + high


def _lines_for_rows(
    scan: Scan, motion: Motion, config: CorrectionConfig, grid: ProductGrid, rows: tuple[int, int]
) -> tuple[int, int]:
    """Range of scan lines that rows of the product can come from, with one line of margin."""
    low, high = _skew(scan, motion, config)
    q_y = torch.tensor([rows[0], rows[1] - 1], dtype=torch.float64) * grid.pitch_mm + grid.origin_y_mm
    reach = torch.cat([q_y - low, q_y - high]) / torch.linalg.vector_norm(motion.n)
    line = line_at(scan.travel, reach)
    start, stop = math.floor(float(line.min())) - 1, math.ceil(float(line.max())) + 2
    return max(start, 0), min(stop, scan.lines)


def _empty_strip(scan: Scan, grid: ProductGrid, rows: tuple[int, int]) -> ProductStrip:
    shape = (rows[1] - rows[0], grid.columns)
    return ProductStrip(
        row=rows[0],
        color=torch.zeros(*shape, scan.left.shape[2], dtype=scan.left.dtype),
        height=torch.full(shape, torch.nan),
        valid=torch.zeros(shape, dtype=torch.bool),
        source=torch.full((*shape, 2), torch.nan),
    )
