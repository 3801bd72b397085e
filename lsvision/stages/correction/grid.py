"""What a product looks like: its options, and the grid of cells that holds a scan."""

import math

import torch
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.geometry import product_axes, travel_at
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.types import Motion, ProductGrid, Rig, Scan


def plan_product(scan: Scan, motion: Motion, config: CorrectionConfig) -> ProductGrid:
    """Grid that holds everything of a scan: the whole field at every depth of the range, from first to last line.

    Raises:
        FileFormatError: the scan has but one line.
    """
    pitch = config.pitch_mm if config.pitch_mm is not None else abs(scan.travel.line_pitch_mm)
    if scan.lines < 2:
        raise FileFormatError(scan.path, f"expected at least two lines, which a surface needs, got {scan.lines}")
    x, z = _field(scan.rig, config)
    axes = product_axes(motion.n)
    q_x = x * axes[0, 0] + z * axes[0, 2]
    offset = x * axes[1, 0] + z * axes[1, 2]
    ends = torch.linalg.vector_norm(motion.n) * travel_at(scan.travel, torch.tensor([0.0, scan.lines - 1.0]).double())
    low_y, high_y = float(ends.min() + offset.min()), float(ends.max() + offset.max())
    return ProductGrid(
        rows=math.floor((high_y - low_y) / pitch) + 1,
        columns=math.floor(float(q_x.max() - q_x.min()) / pitch) + 1,
        pitch_mm=pitch,
        origin_y_mm=low_y,
        origin_x_mm=float(q_x.min()),
    )


def _field(rig: Rig, config: CorrectionConfig) -> tuple[Tensor, Tensor]:
    """(x, z), mm, of the four corners of the left camera's field over the range of heights."""
    low, high = config.height_range_mm
    z = rig.zero_disparity_mm - torch.tensor([low, low, high, high], dtype=torch.float64)
    u = torch.tensor([0.0, rig.width_px - 1.0] * 2, dtype=torch.float64)
    return (u - rig.principal_left_px) / rig.focal_length_px * z, z
