"""Standard deviations of positions against Monte Carlo draws of the depth and of n through the model itself."""

import dataclasses
from pathlib import Path

import pytest
import torch

from lsvision.geometry import ProductFrame, depth_sigma, displace, focal_length_px, product_axes
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.uncertainty import EncoderRepair, drift_per_metre, position_sigma
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, Motion, Scan, StoredDepth, TensorImage, Travel
from tests.stages.rendered import PITCH, SMALL_RIG

N = torch.tensor([-0.03, 1.02, 0.05], dtype=torch.float64)
ROOT = torch.tensor([[2e-3, 0.0, 0.0], [5e-4, 1e-3, 0.0], [-1e-3, 0.0, 3e-3]], dtype=torch.float64)
MOTION = Motion(N, ROOT @ ROOT.mT)


def scan_of(lines: int, travel: Travel) -> Scan:
    depth = torch.full((lines, SMALL_RIG.width_px, 1), 790.0)
    color = torch.zeros(lines, SMALL_RIG.width_px, 3, dtype=torch.uint8)
    return Scan(Path("plane"), SMALL_RIG, travel, DepthView(TensorImage(color), TensorImage(depth)))


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_equals_monte_carlo(transport) -> None:
    log = 7.0 + PITCH * torch.arange(500, dtype=torch.float64)
    scan = scan_of(500, Travel(PITCH, log, transport))
    line, column, z = 444.0, 400.0, 790.0
    slope = (column - SMALL_RIG.principal_left_px) / focal_length_px(SMALL_RIG)
    axes, y = product_axes(N), (-1.0 if transport == "reverse" else 1.0) * 444 * PITCH
    noise = torch.randn(200_000, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    drawn_z = z + 0.3 * noise[:, 0]
    measured = torch.stack([slope * drawn_z, torch.full_like(drawn_z, y), drawn_z], dim=-1)
    points = displace(measured, N + noise[:, 1:] @ ROOT.mT) @ axes.mT
    frame = ProductFrame(scan.rig, scan.travel, N)
    cell = [torch.full((1, 1), float(value), dtype=torch.float64) for value in (column, line, 0.3)]
    sigma = position_sigma(frame, MOTION.covariance, *cell)
    torch.testing.assert_close(sigma[0, 0], points.std(0), rtol=0.01, atol=0)


def test_by_hand() -> None:
    # Straight below the left camera, the depth of a still object: one axis, no travel.
    motion = Motion(torch.tensor([0.0, 1.0, 0.0]).double(), torch.diag(torch.tensor([1e-6, 4e-6, 9e-6]).double()))
    z, c = 800.0, SMALL_RIG.principal_left_px
    matched = 0.1 * z**2 / (focal_length_px(SMALL_RIG) * SMALL_RIG.baseline_mm)
    known = depth_sigma(SMALL_RIG, torch.full((1, 1), z, dtype=torch.float64), 0.1)
    frame = ProductFrame(SMALL_RIG, Travel(PITCH), motion.n)
    sigma = position_sigma(frame, motion.covariance, torch.full((1, 1), c).double(), torch.zeros(1, 1).double(), known)
    torch.testing.assert_close(sigma[0, 0], torch.tensor([0.0, 0.0, matched], dtype=torch.float64))
    assert drift_per_metre(motion) == pytest.approx((1.0, 2.0, 3.0))
    longer = dataclasses.replace(motion, n=2 * motion.n)
    assert drift_per_metre(longer) == pytest.approx((0.5, 1.0, 1.5))


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_repaired_travel_moves_points_along_the_motion(transport) -> None:
    travel_sigma_mm = torch.zeros(500, dtype=torch.float64)
    travel_sigma_mm[100:200] = 0.7
    plain = Travel(PITCH, PITCH * torch.arange(500, dtype=torch.float64), transport)
    repaired = dataclasses.replace(plain, sigma_mm=travel_sigma_mm)
    line = torch.tensor([50.0, 99.5, 150.0, 300.0]).double()
    cell = torch.full_like(line, 400.0), line, torch.full_like(line, 0.3)
    without, found = (
        position_sigma(ProductFrame(SMALL_RIG, t, N), MOTION.covariance, *cell) for t in (plain, repaired)
    )
    assert torch.equal(found[:, ::2], without[:, ::2])
    added = torch.linalg.vector_norm(N) * torch.tensor([0.0, 0.35, 0.7, 0.0]).double()
    torch.testing.assert_close(found[:, 1], without[:, 1].hypot(added))
    assert EncoderRepair.of(plain) is None
    assert EncoderRepair.of(repaired) == EncoderRepair(100, 0.7)


@pytest.mark.parametrize("known", [False, True])
def test_products_carry_it_on_request(known: bool) -> None:
    scan = scan_of(120, Travel(PITCH))
    config = CorrectionConfig(height_range_mm=(-30.0, 30.0), strip_rows=1000, uncertainty=True)
    sigma_map = torch.full(scan.images.depth.shape, 0.05)
    sigma_map[:, 300:] = 0.2
    depth = StoredDepth(scan.images.depth, TensorImage(sigma_map) if known else None)
    (strip,) = correct_scan(scan, depth, MOTION, config)
    assert torch.equal(strip.sigma.isfinite().all(-1), strip.valid)
    line, column = (strip.source[..., part].double() for part in range(2))
    frame = ProductFrame(scan.rig, scan.travel, N)
    z = frame.depth(column, strip.height.double() - frame.height_over_relief_mm)
    at_cell = torch.where(column < 299, 0.05, 0.2).double()
    if not known:
        at_cell = depth_sigma(scan.rig, z, config.disparity_sigma_px)
    expected = position_sigma(frame, MOTION.covariance, column, line, at_cell)
    clear = strip.valid & ((column - 299.5).abs() > 1)
    torch.testing.assert_close(strip.sigma[clear], expected[clear].float(), rtol=1e-4, atol=1e-6)
    plain = dataclasses.replace(config, uncertainty=False)
    (without,) = correct_scan(scan, depth_of(scan), MOTION, plain)
    assert without.sigma is None
