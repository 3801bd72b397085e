"""Sigmas of heights by a raw rig against rigs that are drawn from its covariance."""

from dataclasses import replace

import pytest
import torch

from lsvision.geometry import RawPair, ideal_rig, quantities_of, slope_at, with_covariance
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan, rig_errors_of
from lsvision.stages.correction.rig_errors import RigErrors
from lsvision.types import RIG_QUANTITIES, RawCamera, RawRig, StoredDepth, TensorImage, Travel
from tests.stages.correction.test_uncertainty import MOTION, N, scan_of
from tests.stages.rendered import PITCH, SMALL_RIG

RAW = RawRig(893, 80.0, 354.0, RawCamera(114.1, 446.0, 0.2212, (0.01, 0.0)), RawCamera(113.6, 447.0, -0.2203))
SIGMA = {"focal_length_mm": 0.02, "principal_point_px": 0.3, "turn_deg": 0.02, "distortion.0": 1e-3, "slope_z": 1e-4}


def drawn_covariance() -> torch.Tensor:
    """Sigmas of the size of a calibration's, correlated at random."""
    sigma = [max(value for key, value in {**SIGMA, "": 1e-3}.items() if name.endswith(key)) for name in RIG_QUANTITIES]
    mixed = torch.randn(14, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    unit = mixed / mixed.square().sum(-1, keepdim=True).sqrt()
    factor = torch.tensor(sigma, dtype=torch.float64)[:, None] * unit
    return factor @ factor.mT


def test_equals_rigs_that_are_drawn():
    covariance, rig, z_range = drawn_covariance(), ideal_rig(RAW), (770.0, 830.0)
    found = RigErrors.of(with_covariance(RAW, covariance), rig, N, z_range)
    columns = torch.linspace(0.0, rig.width_px - 1.0, 65, dtype=torch.float64)
    column, z = (
        part.flatten() for part in torch.meshgrid(columns, torch.linspace(*z_range, 5).double(), indexing="ij")
    )
    x = slope_at(rig, column) * z
    there = torch.stack([x, torch.zeros_like(x), z], dim=-1)
    pair = RawPair.of(RAW)
    left, right = pair.seen_left(there, N).column, pair.seen_right(there, N).column
    noise = torch.randn(2000, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
    others = quantities_of(RAW) + noise @ torch.linalg.cholesky(covariance).mT
    pairs = RawPair.of(RAW, others[:, None].expand(-1, len(z), -1))
    heights = z - pairs.meet(left.expand(2000, -1), right.expand(2000, -1), N).z
    plane = torch.stack([torch.ones_like(x), x - x.mean()], dim=-1)
    fitted = torch.linalg.lstsq(plane, heights.mT).solution
    bend = heights - (plane @ fitted).mT
    stated = found.sigma_mm(column, z)
    assert float((bend.square().mean(0).sqrt() / stated - 1).abs().max()) < 0.1
    assert found.shift_mm == pytest.approx(float(fitted[0].std()), rel=0.1)
    assert found.tilt == pytest.approx(float(fitted[1].std()), rel=0.1)
    between = found.sigma_mm(columns[:-1] + 7.3, torch.full((64,), 801.7).double())
    beside = found.sigma_mm(columns, torch.full((65,), 801.7).double())
    assert bool((between <= torch.maximum(beside[1:], beside[:-1]) + 1e-4).all())


def test_an_exact_rig_has_none():
    assert RigErrors.of(RAW, ideal_rig(RAW), N, (770.0, 830.0)) is None
    assert RigErrors.of(None, ideal_rig(RAW), N, (770.0, 830.0)) is None


def test_products_have_it_in_the_sigma_of_heights():
    raw = RawRig(
        SMALL_RIG.width_px, SMALL_RIG.pixel_pitch_um, SMALL_RIG.baseline_mm,
        RawCamera(SMALL_RIG.focal_length_mm, SMALL_RIG.principal_left_px),
        RawCamera(SMALL_RIG.focal_length_mm, SMALL_RIG.principal_right_px),
    )  # fmt: skip
    assert ideal_rig(raw) == SMALL_RIG
    config = CorrectionConfig(height_range_mm=(-30.0, 30.0), strip_rows=1000, uncertainty=True)
    scan = replace(scan_of(60, Travel(PITCH)), raw_rig=raw)
    known = replace(scan, raw_rig=with_covariance(raw, drawn_covariance()))
    depth = StoredDepth(scan.images.depth, TensorImage(torch.full(scan.images.depth.shape, 0.05)))
    (exact,), (found,) = (list(correct_scan(each, depth, MOTION, config)) for each in (scan, known))
    assert torch.equal(exact.height[exact.valid], found.height[found.valid])
    assert torch.equal(exact.sigma[..., :2].nan_to_num(), found.sigma[..., :2].nan_to_num())
    column = found.source[..., 1].double()
    added = (found.sigma[..., 2].square() - exact.sigma[..., 2].square()).clamp(min=0).sqrt()
    expected = rig_errors_of(known, MOTION, config).sigma_mm(column, torch.full_like(column, 790.0)).float()
    torch.testing.assert_close(added[found.valid], expected[found.valid], rtol=0.05, atol=2e-3)
    assert float(expected[found.valid].max()) > 0.01
