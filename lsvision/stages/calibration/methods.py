"""Methods that estimate board poses and the motion n from corners: each takes a problem and its start to a posterior.

All methods hold the prior on n (and on the poses, where one is wanted) fixed and count every corner once. Their
covariances cover the error of their own result: where the model is curved over the posterior, or an iteration has not
come to its end, they are wider than the information at the result says.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import Gaussian, Posterior, levenberg_marquardt
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.joint import covering, joint, mode_of, widened_where_open
from lsvision.stages.calibration.model import whitened_residuals
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.sequential import as_posterior, sequential
from lsvision.stages.calibration.two_step import two_step


def estimate(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Posterior of the poses and n by the configured method."""
    return METHODS[config.method](problem, start, config)


def least_squares(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Maximum of the posterior by Levenberg-Marquardt on the exact residuals: the reference for the other methods.

    It begins where Gauss-Newton ends: its damping would follow a curved valley in a thousand steps.
    """
    prior = prior_about(start, config)
    mode = mode_of(problem, prior, start, config)

    def residual(state: Tensor) -> Tensor:
        """Whitened residuals of the corners, then of the prior."""
        return torch.cat([whitened_residuals(problem, state), prior.residual(state)], dim=-1)

    begin = torch.where(mode.converged[..., None], mode.state, start)
    solution = levenberg_marquardt(residual, begin, max_iterations=config.max_iterations)
    result = Gaussian(solution.state, solution.factor)
    covered = covering(problem, prior, result, torch.zeros_like(solution.factor[..., :0]), config)
    converged = solution.converged & covered.found
    result = widened_where_open(problem, prior, replace(result, factor=covered.factor), converged)
    path = torch.cat([mode.path, solution.path[1:]])
    return as_posterior(result, path, mode.iterations + solution.iterations, converged)


METHODS = {"joint": joint, "two_step": two_step, "sequential": sequential, "least_squares": least_squares}
