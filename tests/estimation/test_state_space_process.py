"""Processes in state-space form against the kernels they stand for."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.estimation import Process, matern, oscillation
from lsvision.estimation.gaussian_process import exponential, matern32


def f64(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def covariance(process: Process, lag: int) -> Tensor:
    """Of the values of two samples ``lag`` apart."""
    start = process.start_root @ process.start_root.mT
    return (torch.linalg.matrix_power(process.transition, lag) @ start)[..., 0, 0]


def test_batch_equals_loop() -> None:
    sigma, length = torch.rand(2, 3).double() + 0.5, 10 * torch.rand(2, 3).double() + 1
    for states in (1, 2, 3):
        whole, one = matern(states, sigma, length), matern(states, sigma[1, 2], length[1, 2])
        for part in ("transition", "noise_root", "start_root"):
            torch.testing.assert_close(getattr(whole, part)[1, 2], getattr(one, part), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("length", [0.05, 0.7, 5.0, 400.0])
@pytest.mark.parametrize("states", [1, 2, 3])
def test_matern_has_its_kernel_and_stays_stationary(states: int, length: float) -> None:
    process = matern(states, f64(2.0), f64(length))
    kernels = {1: exponential, 2: matern32, 3: _matern52}
    for lag in (0, 1, 2, 7):
        expected = 4.0 * kernels[states](f64(lag / length))
        torch.testing.assert_close(covariance(process, lag), expected, rtol=0, atol=1e-12)
    start = process.start_root @ process.start_root.mT
    ahead = process.transition @ start @ process.transition.mT + process.noise_root @ process.noise_root.mT
    torch.testing.assert_close(ahead, start, rtol=0, atol=1e-8)
    assert (process.noise_root.diagonal() > 0).all()
    assert process.size == states


def test_oscillation_is_a_damped_wave() -> None:
    process = oscillation(f64(2.0), f64(12.0), f64(30.0))
    for lag in (0, 1, 6, 12):
        expected = 4.0 * math.exp(-lag / 30.0) * math.cos(2 * math.pi * lag / 12.0)
        torch.testing.assert_close(covariance(process, lag), f64(expected), rtol=0, atol=1e-12)
    ahead = process.transition @ process.start_root
    ahead = ahead @ ahead.mT + process.noise_root @ process.noise_root.mT
    torch.testing.assert_close(ahead, process.start_root @ process.start_root.mT, rtol=0, atol=1e-12)


def _matern52(distance: Tensor) -> Tensor:
    scaled = math.sqrt(5.0) * distance
    return (1 + scaled + scaled.square() / 3) * torch.exp(-scaled)
