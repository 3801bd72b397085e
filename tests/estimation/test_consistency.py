"""Normalised squares and their chi-square bands."""

import pytest
import torch
from scipy.special import gammaincc, gammaincinv  # scipy.stats takes a second to import

from lsvision.estimation import chi_square_tail, mean_chi_square_band, nees, nis
from tests.estimation.models import random, random_covariance


def test_nees_is_the_quadratic_form():
    P, error = random_covariance(5, 4), random(5, 4)
    expected = (error * torch.linalg.solve(P, error)).sum(-1)
    factor = torch.linalg.cholesky(P) @ torch.linalg.qr(random(4, 4)).Q
    torch.testing.assert_close(nees(error, factor), expected)


def test_cubature_points_lie_at_the_size_of_the_state():
    factor = torch.linalg.cholesky(random_covariance(9))
    points = 3 * factor.mT
    torch.testing.assert_close(nees(points, factor.expand(9, 9, 9)), torch.full((9,), 9.0).double())


def test_nis_by_hand():
    assert nis(torch.tensor([3.0, 4.0]).double()).item() == 25.0


def test_tail_is_scipys():
    value = torch.tensor([[0.0], [3.0], [400.0]]).double()
    expected = gammaincc([0.5, 3.5], value.numpy() / 2)
    torch.testing.assert_close(chi_square_tail(value, torch.tensor([1, 7])), torch.from_numpy(expected))
    torch.testing.assert_close(chi_square_tail(value, 7.0)[:, 0], torch.from_numpy(expected[:, 1]))


@pytest.mark.parametrize(("freedom", "runs", "probability"), [(9, 400, 0.95), (1, 1, 0.99), (3, 50, 0.9)])
def test_band_is_scipys(freedom, runs, probability):
    tail = (1 - probability) / 2
    expected = 2 * gammaincinv(freedom * runs / 2, [tail, 1 - tail]) / runs
    assert mean_chi_square_band(freedom, runs, probability) == pytest.approx(expected, rel=1e-8)
