"""Levenberg-Marquardt on problems with known minima."""

import torch

from lsvision.estimation import levenberg_marquardt
from tests.estimation.models import random, times


def test_linear_problem_is_solved_exactly_and_batch_equals_loop():
    A, b = random(3, 12, 4), random(3, 12)
    found = levenberg_marquardt(lambda x: times(A, x) - b, torch.zeros(3, 4).double())
    torch.testing.assert_close(found.state, torch.linalg.lstsq(A, b[..., None]).solution[..., 0])
    torch.testing.assert_close(found.factor @ found.factor.mT, torch.linalg.inv(A.mT @ A))
    assert found.converged.all()
    alone = levenberg_marquardt(lambda x: times(A[1], x) - b[1], torch.zeros(4).double())
    assert torch.equal(alone.state, found.state[1])


def test_rosenbrock_valley():
    def residual(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([10 * (x[..., 1] - x[..., 0] ** 2), 1 - x[..., 0]], dim=-1)

    found = levenberg_marquardt(residual, torch.tensor([[-1.2, 1.0], [3.0, -4.0]]).double(), max_iterations=100)
    torch.testing.assert_close(found.state, torch.ones(2, 2).double(), rtol=0, atol=1e-8)
    assert found.converged.all()
    assert (found.path[0] == torch.tensor([[-1.2, 1.0], [3.0, -4.0]])).all()


def test_nan_is_not_converged_and_stays_alone():
    A = random(2, 6, 3)
    A[0, 1, 1] = torch.nan
    found = levenberg_marquardt(lambda x: times(A, x) - 1.0, torch.zeros(2, 3).double())
    assert found.converged.tolist() == [False, True]
