"""Whether the corners' residuals are as large as their covariance says: over all boards, and board by board."""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.model import board_rows
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.sequential import filtered

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
    freedom = problem.values - (6 * problem.boards + 3)
    return _beyond_chance((squared.sum(-1) - explained).clamp(min=0), freedom)


def drifting_noise_scale(
    problem: BoardProblem, start: Float[Tensor, "*batch state"], state: Float[Tensor, "*batch state"],
    config: CalibrationConfig,
) -> Float[Tensor, "*batch"]:  # fmt: skip
    """The same of an n that walks at random: by the innovations of the filter, to which a fixed n's residuals are none.

    The poses are free; n has its prior.
    """
    innovations = filtered(problem, start, state, config).whitened_innovations
    freedom = 3.0 * problem.valid.sum((-2, -1)) - 6.0 * problem.boards
    return _beyond_chance(innovations.square().sum((0, -1)), freedom)


def board_chi_square(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch boards"]:
    """Squared residuals of each board in sigmas of the corners' given covariance, per degree of freedom.

    The unknowns are shared out: the six of its own pose to each board, an equal part of n to all.
    """
    freedom = 3.0 * problem.valid.sum(-1) - 6.0 - 3.0 / problem.boards
    return squared_residuals_of_boards(problem, state) / freedom


def _beyond_chance(squared: Tensor, freedom: Tensor) -> Tensor:
    unlikely = chi_square_tail(squared, freedom) < _NOISE_TEST_LEVEL
    return torch.where(unlikely, squared / freedom, 1.0)


def squared_residuals_of_boards(
    problem: BoardProblem, state: Float[Tensor, "*batch state"]
) -> Float[Tensor, "*batch boards"]:
    """Squared residuals in sigmas of the given noise, summed over the corners of each board."""
    return board_rows(problem, state).square().sum(-1)
