"""Edges that are not as the model has them: their profile against a known one, and the covariance of their corners."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lsvision.image.board.correlated_noise import BoardNoise
from lsvision.image.board.edge_profile import EdgeProfile, _KnotShapes, board_noise
from lsvision.image.board.saddle import SaddleFit, fit_saddles
from lsvision.image.board.saddle_model import PIXEL_VARIANCE, BlurredEdges, Saddle
from tests.image.board.conftest import SIZE, saddle_windows

CORNERS = 88
EVERY = torch.ones(CORNERS, dtype=torch.bool)


def sampled_windows(samples: int, angle: float, noise: float = 2.0) -> tuple[Tensor, Tensor, Tensor]:
    """Windows of sharp squares whose pixels are means of ``samples x samples`` points, their positions and angles."""
    position = torch.rand(CORNERS, 2, dtype=torch.float64) - 0.5
    angles = torch.tensor([angle, angle + math.pi / 2 + 0.02]).double() + 0.01 * torch.randn(CORNERS, 2).double()
    axis = (torch.arange(SIZE * samples, dtype=torch.float64) + 0.5) / samples - 0.5 - SIZE // 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    at_u, at_v = (u - position[:, 0, None, None]), (v - position[:, 1, None, None])
    edges = [
        torch.sign(at_u * angles[:, k].cos()[:, None, None] + at_v * angles[:, k].sin()[:, None, None]) for k in (0, 1)
    ]
    windows = torch.nn.functional.avg_pool2d(120 + 90 * edges[0] * edges[1], samples)
    return windows + noise * torch.randn_like(windows), position, angles


def mean_chi_square(error: Tensor, covariance: Tensor) -> float:
    return float((error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1).mean())


def staircase(across: Tensor, angle: float, samples: int) -> Tensor:
    """An edge as pixels of ``samples x samples`` points see it."""
    axis = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    along = (u * math.cos(angle) + v * math.sin(angle)).flatten()
    return torch.sign(across[:, None] + along).mean(-1)


def test_the_profile_is_that_of_the_pixels():
    angle, samples = 0.3, 2
    windows, _, angles = sampled_windows(samples, angle)
    fit = fit_saddles(windows, angles)
    profile = EdgeProfile.of(fit, EVERY)
    model = BlurredEdges.through_corners(
        torch.zeros(1, 2).double(),
        torch.tensor([[angle]]).double(),
        fit.parameters.blur.mean()[None],
        torch.stack([profile.knots / math.cos(angle), torch.zeros_like(profile.knots)]),
    )
    # What another blur would change of the edge is in the fit.
    by_blur = model.by_blur[0, 0] / model.by_blur[0, 0].norm()
    expected, found = (
        profile - by_blur * (profile @ by_blur)
        for profile in (
            staircase(profile.knots, angle, samples) - model.value[0, 0],
            profile.amount[: len(profile.knots)],
        )
    )
    assert expected.abs().max() > 0.1
    assert (found - expected).norm() < 0.4 * expected.norm()


def odd_shapes(saddles: Saddle, knots: Tensor) -> Tensor:
    """Change of the grey values of all pixels by the value of the profile at each knot, of either edge."""
    across = saddles.edges.across
    hats = (1 - (across.abs()[:, :, None] - knots[:, None]).abs() / (knots[1] - knots[0])).clamp(min=0)
    return (hats * (across.sign() * saddles.steps())[:, :, None]).flatten(1, 2)


def masked_fit() -> SaddleFit:
    """Of windows of which some pixels are not fitted, as those beyond the squares are not."""
    windows, _, angles = sampled_windows(2, 0.3)
    return fit_saddles(windows, angles, torch.rand(windows.shape) < 0.9)


def test_values_are_those_of_the_shapes():
    fit = masked_fit()
    profile = EdgeProfile.of(fit, EVERY)
    saddles = fit.saddles(EVERY)
    shapes = profile.amount @ odd_shapes(saddles, profile.knots)
    torch.testing.assert_close(profile.values(saddles), shapes, rtol=0, atol=1e-9)


def test_shapes_near_the_edges_are_those_of_all_pixels():
    fit = masked_fit()
    knots = 0.03 * (torch.arange(40).double() + 0.5)
    near = _KnotShapes.of(fit.saddles(EVERY), fit.residuals.weight, knots)
    every = odd_shapes(fit.saddles(EVERY), knots) * fit.residuals.weight[:, None]
    images = torch.randn(CORNERS, SIZE**2, 3).double()
    torch.testing.assert_close(near.products(images), every @ images)
    torch.testing.assert_close(near.gram(), (every @ every.mT).sum(0))


def test_the_profile_solves_the_ridge_regression_over_all_pixels():
    fit = masked_fit()
    profile = EdgeProfile.of(fit, EVERY)
    width = (fit.parameters.blur.square().mean() + PIXEL_VARIANCE).sqrt()
    torch.testing.assert_close(profile.knots, 0.1 * width * (torch.arange(50).double() + 0.5))
    shapes = odd_shapes(fit.saddles(EVERY), profile.knots) * fit.residuals.weight[:, None]
    known = torch.linalg.qr(fit.residuals.jacobian[:, :18].mT).Q
    left = shapes - (shapes @ known) @ known.mT
    normal, right = (left @ shapes.mT).sum(0), (left @ fit.misfit[..., None]).sum(0)[:, 0]
    noise = fit.residual.square().mean()
    variance = (right.square().sum() - noise * normal.trace()) / normal.square().sum()
    ridge = noise / variance + 1e-9 * normal.diagonal().mean()
    expected = torch.linalg.solve(normal + ridge * torch.eye(100).double(), right)
    torch.testing.assert_close(profile.amount, expected, rtol=0, atol=1e-9)


def test_noise_is_no_profile():
    windows, _, angles = sampled_windows(12, 0.3, noise=4.0)
    profile = EdgeProfile.of(fit_saddles(windows, angles), EVERY)
    assert profile.amount.abs().max() < 0.02


def boards(samples: int, angle: float) -> tuple[SaddleFit, Tensor]:
    windows, position, angles = sampled_windows(samples, angle, noise=4.0)
    fit = fit_saddles(windows, angles)
    assert fit.valid.all()
    return fit, fit.position - position


@pytest.mark.parametrize("slope", [0.05, 0.18, 1 / 3, 1 / 2, 0.65, 1.0])
def test_covariance_covers_where_few_points_make_a_pixel(slope: float):
    fit, error = boards(3, math.atan(slope))
    floor = 1e-6 * torch.eye(2).double()
    assert 1.0 < mean_chi_square(error, board_noise(fit, EVERY).covariance(EVERY) + floor) < 2.8
    if slope in (1 / 2, 1.0):
        without = replace(BoardNoise.of(fit.residuals, EVERY), surviving=2 / SIZE)
        assert mean_chi_square(error, without.covariance(EVERY) + floor) > 8.0


def test_whole_pixels_move_no_corner_between_them():
    fit, error = boards(16, math.atan(1 / 2))
    noise = board_noise(fit, EVERY)
    assert noise.aliased.diagonal().sqrt().max() < 0.003
    assert 1.6 < mean_chi_square(error, noise.covariance(EVERY)) < 2.5


def test_blurred_edges_have_no_profile():
    position, angle = torch.rand(CORNERS, 2).double() - 0.5, torch.tensor([0.46, 0.46 + math.pi / 2]).double()
    angles = angle.expand(CORNERS, 2)
    windows = saddle_windows(position, angles, torch.ones(CORNERS).double())
    fit = fit_saddles(windows + 3 * torch.randn_like(windows), angles)
    noise = board_noise(fit, EVERY)
    assert noise.aliased == 0
    assert noise.surviving == 1
    torch.testing.assert_close(noise.covariance(EVERY), BoardNoise.of(fit.residuals, EVERY).covariance(EVERY))


def test_windows_without_noise_have_a_covariance():
    position, angle = torch.zeros(CORNERS, 2).double(), torch.tensor([0.46, 0.46 + math.pi / 2]).double()
    angles = angle.expand(CORNERS, 2)
    fit = fit_saddles(saddle_windows(position, angles, 0.5 * torch.ones(CORNERS).double()), angles)
    assert board_noise(fit, EVERY).covariance(EVERY).isfinite().all()
