"""How much further the boards contradict each other than their corners' noise allows, and sigmas of n that cover it.

An affine map fits the corners of each board within their noise; what the joint fit leaves beyond that lies between the
boards. It has few degrees of freedom, so that a contradiction stands out which hardly raises the chi-square of all.

Source: Birge 1932, The Calculation of Errors by the Method of Least Squares, Phys. Rev. 40, 207.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import Posterior, chi_square_tail
from lsvision.stages.calibration.problem import BoardProblem

# A scatter so large has less than this probability.
_LEVEL = 1e-4


def scatter(
    problem: BoardProblem,
    squared: Float[Tensor, "*batch"],
    posterior: Posterior,
    noise_scale: Float[Tensor, "*batch"],
    prior_sigma: float,
) -> Float[Tensor, "*batch"]:
    """Chi-square between the boards per degree of freedom, in sigmas of the scaled noise; 1 where chance explains it.

    Args:
        squared: residuals at the posterior's mean in sigmas of the scaled noise.
        noise_scale: of the corners.
        prior_sigma: of each component of n.
    """
    planar = 9 if not bool(problem.body_points[..., 2].any()) else 12
    within = problem.affine_rows[..., planar:, -1].square().sum((-2, -1))
    between = (squared - within / noise_scale).clamp(min=0)
    known_by_prior = posterior.factor[..., -3:, :].square().sum((-2, -1)) / prior_sigma**2
    freedom = (planar - 6.0) * problem.boards - 3.0 + known_by_prior.clamp(max=3.0)
    unlikely = chi_square_tail(between, freedom) < _LEVEL
    return torch.where(unlikely, (between / freedom).clamp(min=1.0), 1.0)


def widened(
    covariance: Float[Tensor, "*batch 3 3"], factor: Float[Tensor, "*batch"], prior_sigma: float
) -> Float[Tensor, "*batch 3 3"]:
    """Covariance of n whose information beyond the prior's is divided by a factor: never wider than the prior."""
    eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device) / prior_sigma**2
    usable = torch.isfinite(covariance).all((-2, -1))
    information = torch.linalg.inv(torch.where(usable[..., None, None], covariance, eye)) - eye
    wide = torch.linalg.inv(information / factor[..., None, None] + eye)
    return torch.where((usable & (factor > 1))[..., None, None], (wide + wide.mT) / 2, covariance)
