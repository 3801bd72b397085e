"""Gaussian processes by their values at knots."""

import math

import pytest
import torch

from lsvision.estimation.gaussian_process import covariance_root, cubic_weights, exponential, matern32, narrow_band

PLACE = torch.arange(12, dtype=torch.float64)


def test_kernels_have_their_published_values():
    distance = torch.tensor([0.0, 1.0, -1.0], dtype=torch.float64)
    e = math.exp(-math.sqrt(3.0))
    torch.testing.assert_close(matern32(distance), distance.new_tensor([1.0, (1 + math.sqrt(3.0)) * e] * 2)[[0, 1, 3]])
    torch.testing.assert_close(exponential(distance), distance.new_tensor([1.0, math.exp(-1), math.exp(-1)]))
    half_wave = narrow_band(torch.tensor([2.0]).double(), wavelength=4.0, coherence=1e9)
    assert half_wave.item() == pytest.approx(-1.0)


@pytest.mark.parametrize("kernel", [exponential, matern32, lambda d: narrow_band(d, 5.0, 1e9)])
def test_a_root_gives_back_its_covariance_even_if_singular(kernel):
    covariance = kernel(PLACE[:, None] - PLACE)
    root = covariance_root(covariance)
    torch.testing.assert_close(root @ root.mT, covariance, rtol=0, atol=1e-10)
    lengths = root.norm(dim=0)
    assert (lengths.diff() >= -1e-9).all()


def test_weights_are_exact_for_quadratics_and_at_knots():
    position = torch.linspace(1.0, 10.0, 37, dtype=torch.float64)
    weights = cubic_weights(position, 12)
    torch.testing.assert_close(weights @ (0.3 * PLACE.square() - PLACE + 2.0), 0.3 * position.square() - position + 2.0)
    torch.testing.assert_close(cubic_weights(PLACE[3:4], 12)[0], torch.eye(12, dtype=torch.float64)[3])
