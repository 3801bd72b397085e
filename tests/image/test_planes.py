"""Plane fits in windows of a map: exact, robust, and invalid where the map is."""

import pytest
import torch

from lsvision.image.planes import fit_local_planes
from lsvision.types import TensorImage

HALF = (6, 4)


def plane(lines: int = 60, width: int = 80) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(lines).double(), torch.arange(width).double(), indexing="ij")
    return 800.0 + 0.013 * u - 0.021 * v


def at(position: torch.Tensor) -> torch.Tensor:
    return 800.0 + 0.013 * position[:, 0] - 0.021 * position[:, 1]


def fit(values, position, wanted=None):
    wanted = torch.ones(len(position), dtype=torch.bool) if wanted is None else wanted
    return fit_local_planes(TensorImage(values[..., None]), position, wanted, HALF)


@pytest.fixture
def points():
    return 8 + torch.rand(12, 2).double() * torch.tensor([60.0, 40.0])


def test_batch_equals_loop(points):
    noisy = plane() + 0.1 * torch.randn(60, 80).double()
    together = fit(noisy, points)
    for i in range(len(points)):
        alone = fit(noisy, points[i : i + 1])
        torch.testing.assert_close(alone.value[0], together.value[i], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.variance[0], together.variance[i], rtol=1e-9, atol=0)
    assert together.valid.all()


def test_exact_on_a_plane(points):
    planes = fit(plane(), points)
    torch.testing.assert_close(planes.value, at(points), rtol=0, atol=1e-6)
    torch.testing.assert_close(planes.slope, torch.tensor([[0.013, -0.021]]).double().expand(12, 2), rtol=0, atol=1e-6)
    assert (planes.variance < 1e-12).all()
    assert planes.valid.all()


def test_equals_least_squares(points):
    noisy = plane() + 0.1 * torch.rand(60, 80).double()  # uniform: nothing to call an outlier
    planes = fit(noisy, points)
    for i, (u, v) in enumerate(points.tolist()):
        rows = torch.arange(round(v) - HALF[1], round(v) + HALF[1] + 1)
        columns = torch.arange(round(u) - HALF[0], round(u) + HALF[0] + 1)
        y, x = torch.meshgrid(rows.double() - v, columns.double() - u, indexing="ij")
        design = torch.stack([torch.ones_like(x), x, y], -1).reshape(-1, 3)
        window = noisy[rows][:, columns].reshape(-1, 1)
        solution = torch.linalg.lstsq(design, window).solution
        torch.testing.assert_close(planes.value[i], solution[0, 0], rtol=0, atol=1e-7)
        variance = (window - design @ solution).square().sum() / (len(window) - 3)
        expected = variance * torch.linalg.inv(design.mT @ design)[0, 0]
        torch.testing.assert_close(planes.variance[i], expected, rtol=1e-6, atol=0)


def test_a_fifth_of_outliers_and_holes_changes_little(points):
    noise = 0.05
    values = plane() + noise * torch.randn(60, 80).double()
    values[torch.rand(60, 80) < 0.2] += 30.0
    values[torch.rand(60, 80) < 0.2] = torch.nan
    planes = fit(values, points)
    assert planes.valid.all()
    assert (planes.value - at(points)).square().mean().sqrt() < 0.03


def test_a_nearer_surface_at_the_side_of_the_window_is_ignored():
    values = plane() + 0.02 * torch.randn(60, 80).double()
    values[:, :36] -= 8.0  # 2 of the 13 columns of the windows about column 40
    points = torch.tensor([[40.0, 20.0], [40.3, 30.2]], dtype=torch.float64)
    planes = fit(values, points)
    assert planes.valid.all()
    torch.testing.assert_close(planes.value, at(points), rtol=0, atol=0.02)


def test_variance_predicts_the_error():
    points = torch.tensor([[40.3, 30.2]]).double().expand(300, 2)
    errors, variances = [], []
    for _ in range(200):
        planes = fit(plane() + 0.1 * torch.randn(60, 80).double(), points[:1])
        errors.append(planes.value - at(points[:1]))
        variances.append(planes.variance)
    assert abs(torch.cat(errors).std() / torch.cat(variances).mean().sqrt() - 1) < 0.15


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("slope", [0.001, 0.01, 0.05])
@pytest.mark.parametrize("step", [0.05, 0.2])
def test_variance_covers_rounding(step, slope, noise):
    """Whether a window lies within one step, where no residual shows the rounding, or spans many."""
    points = 6 + torch.rand(30, 2).double() * torch.tensor([66.0, 46.0])
    v, u = torch.meshgrid(torch.arange(60).double(), torch.arange(80).double(), indexing="ij")
    errors, variances = [], []
    for angle in torch.linspace(0.3, 6.0, 12).double():
        along_u, along_v, middle = slope * angle.cos(), slope * angle.sin(), 800 + torch.rand(1).double()
        exact = middle + along_u * (u - 40) + along_v * (v - 30) + noise * torch.randn(60, 80).double()
        planes = fit(((exact / step).round() * step).float(), points)
        errors.append(planes.value - (middle + along_u * (points[:, 0] - 40) + along_v * (points[:, 1] - 30)))
        variances.append(planes.variance)
        assert planes.valid.all()
    error, sigma = torch.cat(errors), torch.cat(variances).sqrt()
    if slope > 0.001 or step < 0.2:  # else most maps are one step, and show none
        assert (error / sigma).square().mean().sqrt() < 1.5
    assert error.abs().max() < 0.6 * step


def test_the_precision_of_numbers_is_a_floor(points):
    planes = fit(plane().float(), points)
    error = (planes.value - at(points)).abs()
    assert (error <= 3 * planes.variance.sqrt()).all()
    assert (planes.variance.sqrt() > 1e-5).all()


def test_empty_thin_and_unwanted_windows_are_not_seen():
    values = plane()
    values[:30] = torch.nan
    values[40, 60] = torch.nan
    points = torch.tensor([[40.0, 15.0], [40.0, 26.5], [40.0, 45.0], [torch.nan, torch.nan], [60.0, 40.0]]).double()
    wanted = torch.tensor([True, True, True, False, True])
    planes = fit(values, points, wanted)
    assert planes.valid.tolist() == [False, False, True, False, True]
    torch.testing.assert_close(planes.value[[2, 4]], at(points[[2, 4]]), rtol=0, atol=1e-6)
    assert not fit(values, points, torch.zeros(5, dtype=torch.bool)).valid.any()


def test_windows_at_the_rim_use_what_lies_within():
    points = torch.tensor([[0.0, 0.0], [79.0, 59.0]]).double()
    planes = fit(plane(), points)
    assert planes.valid.all()
    torch.testing.assert_close(planes.value, at(points), rtol=0, atol=1e-6)
