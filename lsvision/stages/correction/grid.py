"""The grid of cells that holds everything a scan saw, and the lines of the scan that its rows come from."""

import math

import torch

from lsvision.errors import FileFormatError
from lsvision.geometry import ProductFrame, object_pitch_mm, zero_disparity_mm
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.types import Motion, ProductGrid, Scan

# What no scan has: a wrong unit or motion makes products that fill any disk.
_MOST_CELLS = 1000  # for each pixel
_MOST_EXTENT = 10  # times the travel and the field together


def plan_product(scan: Scan, motion: Motion, config: CorrectionConfig) -> ProductGrid:
    """Grid that holds the whole field at every depth of the range, from the first line of a scan to its last.

    Raises:
        FileFormatError: the scan has only one line, or its product would be of a size that no scan has.
    """
    pitch = config.pitch_mm if config.pitch_mm is not None else abs(scan.travel.line_pitch_mm)
    if scan.lines < 2:
        raise FileFormatError(scan.path, f"expected at least two lines, which a surface needs, got {scan.lines}")
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    low, high = config.height_range_mm
    field = frame.field(zero_disparity_mm(scan.rig) - torch.tensor([low, high], dtype=torch.float64))
    q_x, offset = field[..., 0], field[..., 1]
    ends = frame.along(torch.tensor([0.0, scan.lines - 1.0], dtype=torch.float64))
    low_y, high_y = float(ends.min() + offset.min()), float(ends.max() + offset.max())
    length_mm, width_mm = high_y - low_y, float(q_x.max() - q_x.min())
    _check_extent(scan, length_mm, width_mm, pitch)
    return ProductGrid(
        rows=math.floor(length_mm / pitch) + 1,
        columns=math.floor(width_mm / pitch) + 1,
        pitch_mm=pitch,
        origin_y_mm=low_y,
        origin_x_mm=float(q_x.min()),
    )


def offset_range(
    frame: ProductFrame, grid: ProductGrid, columns: slice, config: CorrectionConfig
) -> tuple[float, float]:
    """Least and greatest part of q_y, mm, that comes from the place across the line, over some columns of a product."""
    z = zero_disparity_mm(frame.rig) - torch.tensor(config.height_range_mm, dtype=torch.float64)
    return frame.offset_range(grid.q_x(columns)[[0, -1]], z)


def most_lines(frame: ProductFrame, grid: ProductGrid, config: CorrectionConfig, rows: int) -> int:
    """Most lines of a scan that strips of so many rows of its product come from: by their height, pitch and skew."""
    low, high = offset_range(frame, grid, slice(0, grid.columns), config)
    first = torch.arange(0, grid.rows, rows).double()
    ends = torch.stack([first, (first + rows - 1).clamp(max=grid.rows - 1)])
    q_y = grid.origin_y_mm + grid.pitch_mm * ends
    line = frame.line(torch.cat([q_y - low, q_y - high]))
    return math.ceil(float((line.amax(0) - line.amin(0)).max()))


def source_dtype(lines: int) -> torch.dtype:
    """Type of the positions in a scan of so many lines: single precision is too coarse from 65 536 lines on.

    It counts lines in steps of 1/256 there, and of 1/16 at a million.
    """
    return torch.float32 if lines <= 2**16 else torch.float64


def _check_extent(scan: Scan, length_mm: float, width_mm: float, pitch_mm: float) -> None:
    """Check the size of a product along and across the motion."""
    scan_mm = scan.lines * scan.travel.line_pitch_mm + scan.rig.width_px * object_pitch_mm(scan.rig)
    if not max(length_mm, width_mm) <= _MOST_EXTENT * scan_mm:  # nor NaN
        problem = f"of a travel and field of {scan_mm:.4g} mm: do calibration and height_range_mm fit the scan?"
    elif not length_mm * width_mm <= _MOST_CELLS * scan.lines * scan.rig.width_px * pitch_mm * pitch_mm:  # nor x / 0
        problem = f"more than {_MOST_CELLS} cells of {pitch_mm:g} mm for each pixel: is the pitch right?"
    elif not pitch_mm <= scan_mm:
        problem = f"less than a cell of {pitch_mm:g} mm: is the pitch right?"
    else:
        return
    raise FileFormatError(scan.path, f"its product would be {length_mm:.4g} x {width_mm:.4g} mm large, {problem}")
