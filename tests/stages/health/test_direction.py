"""The angle between an object's axis and its motion."""

import math
from pathlib import Path

import pytest
import torch

from lsvision.geometry import scaled_rig, slope_at, zero_disparity_mm
from lsvision.stages.health.direction import measure_direction
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.types import DepthView, Motion, Scan, StoredDepth, TensorImage, Travel
from tests.stages.rendered import FULL_RIG

RIG = scaled_rig(FULL_RIG, 16)
N = torch.tensor([0.02, 1.01, -0.01], dtype=torch.float64)
NOMINAL = Motion(N, 1e-8 * torch.eye(3, dtype=torch.float64))


def seen(sideways_deg: float, in_depth_deg: float, *, lines: int = 400, flat: bool = False, seed: int = 0) -> Scan:
    """A scan of an object with a ridge, whose axis departs from its motion, with its depth map."""
    along = torch.arange(lines, dtype=torch.float64)[:, None] * 1.0 * float(torch.linalg.vector_norm(N))
    aside, below = (math.tan(math.radians(angle)) * (along - along.mean()) for angle in (sideways_deg, in_depth_deg))
    slope = slope_at(RIG, torch.arange(RIG.width_px, dtype=torch.float64))[None]
    z = torch.full((lines, RIG.width_px), zero_disparity_mm(RIG), dtype=torch.float64)
    for _ in range(20):  # where each ray meets the surface
        x = slope * z - RIG.baseline_mm / 2 - aside
        height = (0.0 if flat else 12.0) * torch.exp(-(x / 40.0).square())
        z = zero_disparity_mm(RIG) + below - height
    z = z + 0.05 * torch.randn(z.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    left = TensorImage(torch.zeros(lines, RIG.width_px, 1, dtype=torch.uint8))
    return Scan(Path("drawn"), RIG, Travel(1.0), DepthView(left, TensorImage(z[..., None].float())))


def measured(scan: Scan):
    return measure_direction(scan, StoredDepth(scan.images.depth), NOMINAL, LineMotionConfig())


@pytest.mark.parametrize(("sideways", "in_depth"), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (-0.3, 0.2)])
def test_a_trend_of_the_profile_is_the_angle(sideways, in_depth):
    found = measured(seen(sideways, in_depth))
    assert found.sideways_deg == pytest.approx(sideways, abs=0.02)
    assert found.in_depth_deg == pytest.approx(in_depth, abs=0.004)
    assert found.sideways_sigma_deg < 0.02
    assert found.in_depth_sigma_deg < 0.004


@pytest.mark.slow
def test_sigmas_cover_the_errors():
    found = [measured(seen(0.05, -0.05, seed=seed)) for seed in range(12)]
    for axis, truth in (("sideways", 0.05), ("in_depth", -0.05)):
        pulls = [(getattr(f, f"{axis}_deg") - truth) / getattr(f, f"{axis}_sigma_deg") for f in found]
        assert 0.5 < math.sqrt(sum(pull**2 for pull in pulls) / len(pulls)) < 1.8


def test_a_flat_object_shows_its_direction_in_depth_alone():
    found = measured(seen(0.1, 0.1, flat=True))
    assert found.in_depth_deg == pytest.approx(0.1, abs=0.004)
    assert math.isnan(found.sideways_deg)


def test_few_lines_or_no_depth_show_nothing():
    assert math.isnan(measured(seen(0.0, 0.0, lines=20)).in_depth_deg)
    scan = seen(0.0, 0.0, lines=60)
    scan.images.depth.tensor.fill_(torch.nan)
    assert math.isnan(measured(scan).sideways_deg)
