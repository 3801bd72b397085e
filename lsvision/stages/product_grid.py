"""What a product looks like: its options, and the grid of cells that holds a scan."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.errors import ConfigError, FileFormatError
from lsvision.geometry import product_axes, travel_at
from lsvision.image.resampling import Interpolation, Resampler
from lsvision.types import Motion, Rig, Scan


@dataclass(frozen=True)
class CorrectionConfig:
    """How a scan becomes a product.

    ``pitch_mm`` is the side of a product's cell; the scan's own line pitch where it is None. ``strip_rows`` are
    computed at once. A surface counts as continuous between neighbours whose disparities differ by at most ``step_px``:
    at one pixel it is so steep that one of the cameras no longer sees it. Holes of up to ``bridge_px`` samples are
    bridged for colour; their height stays invalid. Depths outside ``height_range_mm`` count as not measured; the wider
    it is, the larger the product. With ``uncertainty`` each cell also gets the standard deviation of its position;
    ``disparity_sigma_px`` is that of the matching, where the depth comes without one.
    """

    pitch_mm: float | None = None
    interpolation: Interpolation = "bicubic"
    resampler: Resampler = "grid_sample"
    strip_rows: int = 512
    step_px: float = 1.0
    bridge_px: int = 32
    height_range_mm: tuple[float, float] = (-60.0, 60.0)
    uncertainty: bool = False
    disparity_sigma_px: float = 0.09


@dataclass(frozen=True)
class ProductGrid:
    """Cells of a product: cell (row, column) lies at q_y = origin_y + row·pitch, q_x = origin_x + column·pitch, mm."""

    rows: int
    columns: int
    pitch_mm: float
    origin_y_mm: float
    origin_x_mm: float


def plan_product(scan: Scan, motion: Motion, config: CorrectionConfig) -> ProductGrid:
    """Grid that holds everything of a scan: the whole field at every depth of the range, from first to last line.

    Raises:
        ConfigError: the pitch is not positive.
        FileFormatError: the scan has but one line.
    """
    pitch = config.pitch_mm if config.pitch_mm is not None else abs(scan.travel.line_pitch_mm)
    if not (pitch > 0 and math.isfinite(pitch)):
        raise ConfigError(f"correction.pitch_mm must be positive, got {pitch}")
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
