"""Posteriors of a batch of problems, with the noise that their residuals ask for: as given, larger, or correlated."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import Posterior, lower_factor
from lsvision.stages.calibration.along_scan import Beforehand, ErrorsAlongScan, by_chance, errors_along_scan
from lsvision.stages.calibration.board_scale import explained_by_size, with_unknown_size
from lsvision.stages.calibration.chosen import merged, scattered
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.methods import estimate
from lsvision.stages.calibration.model import residuals_in_sigmas
from lsvision.stages.calibration.noise import drifting_noise_scale, noise_scale, squared_residuals_of_boards
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.scatter import scatter


@dataclass(frozen=True)
class Estimate:
    """Posteriors of a batch of problems, their noise multiplied by ``noise_scale``, 1 where it is as given.

    ``scatter`` is that between the boards, see ``scatter``; the posteriors do not allow for it.
    """

    posterior: Posterior
    noise_scale: Float[Tensor, "*batch"]
    scatter: Float[Tensor, "*batch"]

    def replaced(self, chosen: Bool[Tensor, "*batch"], part: "Estimate") -> "Estimate":
        """The same with the chosen problems' replaced by those of ``part``, in a row."""
        scale = scattered(chosen, part.noise_scale, self.noise_scale)
        apart = scattered(chosen, part.scatter, self.scatter)
        return Estimate(merged(chosen, part.posterior, self.posterior), scale, apart)


@dataclass(frozen=True)
class NoisyEstimate(Estimate):
    """Posteriors that allow for the errors along the scan that were found."""

    along_scan: ErrorsAlongScan


def estimate_with_noise(
    problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig
) -> NoisyEstimate:
    """Posteriors by the configured method; where residuals are correlated along the scan, those that allow for it."""
    found = estimate_white(problem, start, config)
    whitened = residuals_in_sigmas(problem, found.posterior.mean)
    # Residuals of a result that has not converged say nothing of the corners.
    settled = found.posterior.converged & math.isfinite(config.correlated_odds)
    probability = by_chance(problem, whitened / found.noise_scale.sqrt()[..., None, None, None])
    probability = torch.where(settled, probability, 1.0)
    known = Beforehand(config.process_sigma or 0.0, config.correlated_odds)
    along = errors_along_scan(problem, found.posterior.mean, probability, config.prior_sigma, known)
    if bool(along.found.any()):
        again = estimate_white(along.problem(problem), start[along.found], config)
        found = found.replaced(along.found, again)
    weighed = replace(problem, correlated=along.noise)
    posterior = wider(found.posterior, along.factor_of_n)
    if not _drifts(weighed, config):
        posterior = with_unknown_size(weighed, posterior, found.noise_scale, config.board_scale_sigma)
    return NoisyEstimate(posterior, found.noise_scale, found.scatter, along)


def estimate_white(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Estimate:
    """Posteriors with the noise as the problem has it, or scaled up where the residuals ask for it."""
    posterior = estimate(problem, start, config)
    if _drifts(problem, config):
        scale = drifting_noise_scale(problem, start, posterior.mean, config)
        apart = torch.ones_like(scale)
    else:
        squared = squared_residuals_of_boards(problem, posterior.mean)
        explained = explained_by_size(problem, posterior, config.board_scale_sigma)
        scale = noise_scale(problem, squared, explained)
        apart = scatter(problem, (squared.sum(-1) - explained) / scale, posterior, scale, config.prior_sigma)
    found, larger = Estimate(posterior, scale, apart), scale > 1
    if not bool(larger.any()):
        return found
    again = estimate(problem.scaled(scale).at(larger), start[larger], config)
    return found.replaced(larger, Estimate(again, scale[larger], apart[larger]))


def wider(posterior: Posterior, factor_of_n: Float[Tensor, "*batch 3 3"]) -> Posterior:
    """Posteriors whose covariance of n is larger by that of a factor."""
    larger = factor_of_n.flatten(-2).any(-1)
    if not bool(larger.any()):
        return posterior
    more = torch.nn.functional.pad(factor_of_n, (0, 0, posterior.factor.shape[-2] - 3, 0))
    factor = lower_factor(torch.cat([posterior.factor, more], dim=-1))
    return replace(posterior, factor=torch.where(larger[..., None, None], factor, posterior.factor))


def _drifts(problem: BoardProblem, config: CalibrationConfig) -> bool:
    """Whether n walks at random, so that residuals of one n are no noise."""
    return config.method == "sequential" and bool(config.process_sigma) and problem.correlated is None
