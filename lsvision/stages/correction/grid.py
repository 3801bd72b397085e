"""The grid of cells that holds everything a scan saw."""

import math

import torch

from lsvision.errors import FileFormatError
from lsvision.geometry import ProductFrame, zero_disparity_mm
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.types import Motion, ProductGrid, Scan


def plan_product(scan: Scan, motion: Motion, config: CorrectionConfig) -> ProductGrid:
    """Grid that holds the whole field at every depth of the range, from the first line of a scan to its last.

    Raises:
        FileFormatError: the scan has only one line.
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
    return ProductGrid(
        rows=math.floor((high_y - low_y) / pitch) + 1,
        columns=math.floor(float(q_x.max() - q_x.min()) / pitch) + 1,
        pitch_mm=pitch,
        origin_y_mm=low_y,
        origin_x_mm=float(q_x.min()),
    )
