"""The corner fit: its derivative, its position, its covariance, and what it refuses."""

import math

import pytest
import torch

from lsvision.image.board.saddle import _saddle, fit_saddles
from tests.image.board.conftest import SIZE, saddle_windows


def test_batch_equals_loop(corners):
    position, angles, blur = corners
    windows = saddle_windows(position, angles, blur) + 3 * torch.randn(len(blur), SIZE, SIZE, dtype=torch.float64)
    together = fit_saddles(windows, angles)
    for i in range(0, len(blur), 7):
        alone = fit_saddles(windows[i : i + 1], angles[i : i + 1])
        torch.testing.assert_close(alone.position[0], together.position[i], rtol=0, atol=1e-9)
        torch.testing.assert_close(alone.covariance[0], together.covariance[i], rtol=1e-6, atol=0)
        assert alone.valid[0] == together.valid[i]


def test_model_by_hand():
    # Edges along the axes, blur 1, contrast 10 on 50 with slope 2 along u: at one blur right of and below the corner
    # both edges are erf(1 / sqrt 2), the share of a normal distribution within one sigma. Right of the first edge lies
    # another 4, more of it further down.
    parameters = torch.tensor([[0.5, -0.25, 0.0, math.pi / 2, 1.0, 50, 2, 0, 4, 0, 1, 0, 0, 0, 10, 0, 0]]).double()
    value, _ = _saddle(parameters, torch.tensor([[1.5, 0.5], [0.75, -0.25]]).double(), torch.ones(1, 2).double())
    share = 0.6826894921370859
    expected = torch.tensor([53.0 + (4 + 0.75) * share + 10 * share**2, 51.0]).double()
    torch.testing.assert_close(value[0], expected)


def test_jacobian_is_the_derivative(corners):
    position, angles, blur = (tensor[:3] for tensor in corners)
    levels = 60 * torch.randn(3, 12, dtype=torch.float64)
    parameters = torch.cat([position, angles, blur[:, None], levels], dim=-1)
    axis = torch.arange(-3, 4, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy")).flatten(1)
    weight = (torch.rand(3, 49) > 0.2).double()
    by_autograd = torch.autograd.functional.jacobian(lambda p: _saddle(p, grid, weight)[0], parameters)
    ours = _saddle(parameters, grid, weight)[1]
    for i in range(3):
        torch.testing.assert_close(ours[i].mT, by_autograd[i, :, i], rtol=0, atol=1e-9)


def test_position_is_recovered_without_noise(corners):
    position, angles, blur = corners
    off = angles + 0.5 * (torch.rand_like(angles) - 0.5)
    fit = fit_saddles(saddle_windows(position, angles, blur), off)
    assert fit.valid.all()
    assert (fit.position - position).abs().max() < 0.002
    torch.testing.assert_close(fit.blur_px, blur, rtol=0, atol=0.01)
    torch.testing.assert_close(fit.contrast, torch.full_like(blur, 90.0), rtol=0, atol=0.5)


def test_swapped_colours_and_scaled_brightness_change_nothing(corners):
    position, angles, blur = corners
    windows = saddle_windows(position, angles, blur)
    fit, negative, brighter = (fit_saddles(w, angles) for w in (windows, 255 - windows, 257 * windows))
    for other in (negative, brighter):
        torch.testing.assert_close(other.position, fit.position, rtol=0, atol=1e-6)
        assert other.valid.all()


def test_covariance_predicts_the_scatter():
    count, noise = 300, 4.0
    position = torch.tensor([0.3, -0.4]).double().expand(count, 2)
    angles = torch.tensor([0.3, 0.3 + 1.9]).double().expand(count, 2)
    windows = saddle_windows(position, angles, torch.ones(count).double())
    fit = fit_saddles(windows + noise * torch.randn_like(windows), angles)
    assert fit.valid.all()
    error = fit.position - position
    assert (error.mean(0).abs() < 4 * error.std(0) / math.sqrt(count)).all()
    predicted = fit.covariance.mean(0)
    torch.testing.assert_close(error.std(0), predicted.diagonal().sqrt(), rtol=0.15, atol=0)
    correlation = torch.corrcoef(error.T)[0, 1]
    assert abs(correlation - predicted[0, 1] / predicted.diagonal().prod().sqrt()) < 0.15
    torch.testing.assert_close(fit.residual.square().mean().sqrt(), torch.tensor(noise).double(), rtol=0.02, atol=0)


@pytest.mark.parametrize("texture", [0.0, 6.0])
def test_covariance_allows_for_texture(texture):
    count, noise = 300, 3.0
    position = torch.zeros(count, 2).double()
    angles = torch.tensor([0.3, 0.3 + 1.6]).double().expand(count, 2)
    windows = saddle_windows(position, angles, torch.ones(count).double())
    coarse = torch.randn(count, 1, SIZE + 2, SIZE + 2, dtype=torch.float64)
    smooth = torch.nn.functional.avg_pool2d(coarse, 3, 1)[:, 0] * 3
    fit = fit_saddles(windows + noise * torch.randn_like(windows) + texture * smooth, angles)
    scatter = fit.position.square().mean(0).sqrt()
    white = fit.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    gain = fit.correlation_gain.mean().sqrt()
    torch.testing.assert_close(gain * white, scatter, rtol=0.2, atol=0)
    if texture == 0:
        assert abs(gain - 1) < 0.03
    else:
        assert gain > 1.4


def test_uneven_quadrants_pull_no_corner():
    # Reflectance rises across one square only and falls off across the window: every quadrant has a level of its own.
    position = 2 * torch.rand(20, 2, dtype=torch.float64) - 1
    angles = torch.tensor([0.2, 1.9]).double().expand(20, 2)
    windows = saddle_windows(position, angles, torch.ones(20).double())
    axis = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    distance = [
        (u - position[:, 0, None, None]) * math.cos(a) + (v - position[:, 1, None, None]) * math.sin(a)
        for a in (0.2, 1.9)
    ]
    one_square = torch.special.ndtr(distance[0]) * torch.special.ndtr(distance[1])
    fit = fit_saddles(windows + one_square * (20 + 0.8 * u + 0.5 * v) - 0.6 * v, angles)
    assert (fit.position - position).abs().max() < 1e-4


@pytest.mark.parametrize("kind", ["flat", "edge", "noise", "far", "missing"])
def test_windows_without_a_corner_are_refused(kind):
    axis = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    far = torch.tensor([[4.5, -4.5]]).double()
    right_angles, sharp = torch.tensor([[0.0, math.pi / 2]]).double(), torch.ones(1).double()
    window = {
        "flat": torch.full((SIZE, SIZE), 120.0).double(),
        "edge": 120 + 90 * torch.erf(u - 0.3 * v),
        "noise": 120 + 30 * torch.randn(SIZE, SIZE, dtype=torch.float64),
        "far": saddle_windows(far, right_angles, sharp)[0],
        "missing": torch.full((SIZE, SIZE), torch.nan).double(),
    }[kind]
    sensor_noise = 2.0 * torch.randn(10, SIZE, SIZE, dtype=torch.float64)
    assert not fit_saddles(window + sensor_noise, right_angles.expand(10, 2)).valid.any()
