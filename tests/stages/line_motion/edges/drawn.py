"""Drawn scans of a flat sheet over a conveyor: sides that are where they are told to be, and the depth of both."""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, scaled_rig, slope_at, without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.measure import measure_line_motion
from lsvision.types import LineMotion, Motion, Scan, StereoPair, StoredDepth, TensorImage, Travel
from tests.stages.rendered import FULL_RIG

RIG, LINES, PITCH, Z, BELOW = scaled_rig(FULL_RIG, 8), 400, 0.56, 800.0, 26.0
N = torch.tensor([0.02, 1.01, 0.01], dtype=torch.float64)
FRAME = ProductFrame(RIG, Travel(PITCH), N)
CONFIG = LineMotionConfig(common_error_px=0.0, block_lines=200, halo_lines=60)
LINE = torch.arange(LINES).double()


@dataclass(frozen=True)
class Stripe:
    """A stripe of brightness between two places, x mm by line, at a depth; it hides what lies below."""

    left: Tensor
    right: Tensor
    brightness: float
    z: float = Z


def shaken(rms_mm: float = 0.5) -> Tensor:
    """Displacement sideways by line: two waves, of which the object is as long as one and a half and three."""
    return rms_mm * (torch.sin(LINE * PITCH / 12.0) + torch.sin(LINE * PITCH / 25.0 + 1.0))


def along(x_mm: float, dx: Tensor, per_line_mm: float = 0.0) -> Tensor:
    """Places of a straight edge that runs along the motion, or off it by some distance a line."""
    return x_mm + LINE * PITCH * float(N[0]) + per_line_mm * LINE + dx


def sheet(dx: Tensor, left: float = 0.0, right: float = 300.0, per_line_mm: float = 0.0) -> Stripe:
    return Stripe(along(left, dx, per_line_mm), along(right, dx, per_line_mm), 130.0)


def scan_of(stripes: list[Stripe], seed: int = 0, noise: float = 3.0) -> tuple[Scan, StoredDepth]:
    """Both images and the depth of stripes over a conveyor, with noise."""
    generator = torch.Generator().manual_seed(seed)
    images = []
    for camera in ("left", "right"):
        slope = slope_at(RIG, torch.arange(RIG.width_px).double(), camera)
        origin = 0.0 if camera == "left" else 354.0
        image = torch.full((LINES, RIG.width_px), 40.0).double()
        for stripe in stripes:
            image = torch.lerp(
                image, torch.full_like(image, stripe.brightness), covered(stripe, origin + slope * stripe.z)
            )
        image = image + noise * torch.randn(image.shape, generator=generator)
        images.append(TensorImage(image.round().clamp(0, 255).to(torch.uint8)[..., None]))
    slope = slope_at(RIG, torch.arange(RIG.width_px).double())
    z = torch.full((LINES, RIG.width_px), Z + BELOW).double()
    for stripe in stripes:
        z = torch.where(covered(stripe, slope * stripe.z) > 0.5, stripe.z, z)
    z = z + 0.02 * torch.randn(z.shape, generator=generator)
    scan = Scan(Path("sheet"), RIG, Travel(PITCH), StereoPair(*images))
    return scan, StoredDepth(TensorImage(z.float()[..., None]))


def covered(stripe: Stripe, x: Tensor) -> Tensor:
    """Share of cells at x that a stripe covers, blurred by the optics."""
    blur = 0.8 * math.sqrt(2.0) * float((x[1] - x[0]).abs())
    return (torch.erf((x - stripe.left[:, None]) / blur) - torch.erf((x - stripe.right[:, None]) / blur)) / 2


def measured(stripes: list[Stripe], seed: int = 0, config: LineMotionConfig = CONFIG) -> LineMotion:
    """The motion that a drawn scan shows."""
    scan, depth = scan_of(stripes, seed)
    return measure_line_motion(scan, depth, Motion(N, torch.zeros(3, 3).double()), config).motion


def errors_of(found: LineMotion, dx: Tensor) -> Tensor:
    """Errors of δx but for their mean, and their trend where no waves show it, in units of their standard deviation."""
    off = found.dx_mm - dx
    return (off - off.mean() if found.findings[0].waves else without_trend(LINE)(off)) / found.sigma[:, 0]
