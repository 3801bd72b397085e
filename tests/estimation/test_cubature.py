"""Statistical linear regression: exact where linear, the derivative where narrow, its error's covariance."""

import itertools
import math

import pytest
import torch

from lsvision.estimation import jacobian, slr
from tests.estimation.models import STATE, corner, random, random_covariance, times


def test_batch_equals_loop():
    mean, chol = STATE + 0.01 * random(4, 3, 9), torch.linalg.cholesky(1e-3 * random_covariance(4, 3, 9))
    batched = slr(corner, mean, chol)
    for i in range(4):
        alone = slr(corner, mean[i, 1], chol[i, 1])
        for part, whole in ((alone.A, batched.A), (alone.b, batched.b), (alone.error, batched.error)):
            assert torch.equal(part, whole[i, 1])


def test_a_square_is_regressed_as_worked_out_by_hand():
    """h = x² over N(m, s²): A = 2 m, b = s² - m², and a pair of points shows no error about that line."""
    square = slr(torch.square, torch.tensor([3.0]).double(), torch.tensor([[0.5]]).double())
    assert [part.item() for part in (square.A, square.b, square.error)] == pytest.approx([6.0, 0.25 - 9.0, 0.0])


def test_moments_are_those_of_the_points():
    mean, chol = STATE, torch.linalg.cholesky(1e-2 * random_covariance(9))
    model = slr(corner, mean, chol)
    points = torch.stack([mean + s * math.sqrt(9) * chol[:, i] for s in (1, -1) for i in range(9)])
    values = torch.stack([corner(point) for point in points])
    deviations = values - values.mean(0)
    torch.testing.assert_close(model.at(mean), values.mean(0), rtol=1e-13, atol=0)
    torch.testing.assert_close(times(model.A, mean) + model.b, values.mean(0), rtol=1e-13, atol=0)
    explained, unexplained = model.A @ chol, model.error
    found = explained @ explained.mT + unexplained @ unexplained.mT
    torch.testing.assert_close(found, deviations.mT @ deviations / 18)


def test_linear_function_is_found_exactly():
    A, b = random(5, 4, 9), random(5, 4)
    found = slr(lambda x: times(A, x) + b, random(5, 9), torch.linalg.cholesky(random_covariance(5, 9)))
    torch.testing.assert_close(found.A, A, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.b, b, rtol=1e-12, atol=1e-12)
    assert found.error.abs().max() < 1e-14


def test_regression_tends_to_the_derivative_with_the_square_of_sigma():
    """max |A - jacfwd(h)| of the rotation falls by 100 for every factor 10 in sigma, from 0.1 to 1e-4."""
    derivative = jacobian(corner, STATE)[:, :3]
    errors = []
    for sigma in (1e-1, 1e-2, 1e-3, 1e-4):
        chol = torch.diag(torch.tensor([sigma] * 3 + [1e-3] * 6, dtype=torch.float64))
        errors.append((slr(corner, STATE, chol).A[:, :3] - derivative).abs().max().item())
    for wide, narrow in itertools.pairwise(errors):
        assert wide / narrow == pytest.approx(100.0, rel=0.2)
