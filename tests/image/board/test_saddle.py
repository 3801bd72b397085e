"""The corner fit: its position, its covariance, and the windows that it rejects."""

import math

import pytest
import torch

from lsvision.image.board.saddle import SaddleOptions, fit_saddles
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


def test_position_is_recovered_without_noise(corners):
    position, angles, blur = corners
    off = angles + 0.5 * (torch.rand_like(angles) - 0.5)
    fit = fit_saddles(saddle_windows(position, angles, blur), off)
    assert fit.valid.all()
    assert (fit.position - position).abs().max() < 0.002
    torch.testing.assert_close(fit.blur_px, blur, rtol=0, atol=0.01)
    torch.testing.assert_close(fit.contrast, torch.full_like(blur, 90.0), rtol=0, atol=0.5)


@pytest.mark.parametrize("angle", [0.0, 0.01, 0.3])
def test_sharp_edges_along_the_pixels_lock_no_corner_to_them(angle):
    # Each pixel is the mean over its square: windows of fine pixels, 25 x 25 to a pixel.
    fine = 25
    axis = (torch.arange(SIZE * fine, dtype=torch.float64) + 0.5) / fine - 0.5 - SIZE // 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    position = torch.cat([torch.tensor([[0.25, -0.25], [0.1, 0.35]]).double(), torch.rand(10, 2).double() - 0.5])
    angles = torch.tensor([angle, angle + math.pi / 2]).double().expand(len(position), 2)
    edges = [
        torch.sign((u - at[0]) * math.cos(a) + (v - at[1]) * math.sin(a))
        for at in position
        for a in (angle, angle + math.pi / 2)
    ]
    pictures = torch.stack([120 + 90 * one * other for one, other in zip(edges[::2], edges[1::2], strict=True)])
    windows = torch.nn.functional.avg_pool2d(pictures, fine)
    fit = fit_saddles(windows + torch.randn_like(windows), angles)
    assert fit.valid.all()
    # Fine pixels place an edge along them to a fiftieth of a pixel.
    assert (fit.position - position).abs().max() < 0.025


def test_a_plain_fit_is_near_the_full_one(corners):
    position, angles, blur = corners
    fit = fit_saddles(saddle_windows(position, angles, blur), angles, options=SaddleOptions(plain=True))
    assert fit.valid.all()
    assert (fit.position - position).abs().max() < 0.05


def test_limits_decide_what_is_a_corner(corners):
    position, angles, blur = corners
    noisy = saddle_windows(position, angles, blur) + 9 * torch.randn(len(blur), SIZE, SIZE, dtype=torch.float64)
    near = fit_saddles(noisy, angles, options=SaddleOptions(max_shift_px=1.0))
    assert torch.equal(near.valid, torch.linalg.vector_norm(near.position, dim=-1) < 1.0)
    assert not fit_saddles(noisy, angles, options=SaddleOptions(max_residual=0.05)).valid.any()


def test_swapped_colours_and_scaled_brightness_change_nothing(corners):
    position, angles, blur = corners
    windows = saddle_windows(position, angles, blur)
    fit, negative, brighter = (fit_saddles(w, angles) for w in (windows, 255 - windows, 257 * windows))
    for other in (negative, brighter):
        torch.testing.assert_close(other.position, fit.position, rtol=0, atol=1e-6)
        assert other.valid.all()


def test_covariance_predicts_the_error():
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
