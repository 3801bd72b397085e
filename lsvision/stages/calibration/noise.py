"""Whether the corners' residuals are as large as their covariance says: over all boards, and board by board.

Residuals are weighed with the linearisation's error as well: where only the prior determines n, the mean of the
posterior does not lie on the curve of poses and n that fit.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import Posterior
from lsvision.stages.calibration.linearise import linearise
from lsvision.stages.calibration.problem import BoardProblem

# The noise is scaled up where the given covariance would leave residuals as large with less than this probability.
_NOISE_TEST_LEVEL = 1e-3


def noise_scale(
    problem: BoardProblem, squared: Float[Tensor, "*batch boards"], explained: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Reduced chi-square of the residuals where they are larger than chance allows, else 1.

    Args:
        squared: residuals of each board, see ``squared_residuals_of_boards``.
        explained: part of the squared residuals that is known not to be noise, in sigmas.
    """
    total = (squared.sum(-1) - explained).clamp(min=0)
    freedom = 3.0 * problem.valid.sum((-2, -1)) - (6 * problem.boards + 3)
    unlikely = torch.special.gammaincc(freedom / 2, total / 2) < _NOISE_TEST_LEVEL
    return torch.where(unlikely, total / freedom, 1.0)


def board_chi_square(problem: BoardProblem, posterior: Posterior) -> Float[Tensor, "*batch boards"]:
    """Squared residuals of each board in sigmas of the corners' given covariance, per degree of freedom.

    The unknowns are shared out: the six of its own pose to each board, an equal part of n to all.
    """
    freedom = 3.0 * problem.valid.sum(-1) - 6.0 - 3.0 / problem.boards
    return squared_residuals_of_boards(problem, posterior) / freedom


def squared_residuals_of_boards(problem: BoardProblem, posterior: Posterior) -> Float[Tensor, "*batch boards"]:
    """Squared residuals in sigmas of the given covariance, summed over the corners of each board."""
    corners_alone = problem if problem.pitch is None else replace(problem, pitch=None)
    rows = linearise(corners_alone, posterior.mean, posterior.factor).matrix[..., -1]
    return rows.unflatten(-1, (problem.boards, -1)).square().sum(-1)
