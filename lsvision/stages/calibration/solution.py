"""Posteriors of a batch of problems, with the noise that their residuals ask for: as given, larger, or correlated."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import Posterior
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.correlated import ErrorsAlongScan, errors_along_scan
from lsvision.stages.calibration.methods import estimate
from lsvision.stages.calibration.noise import noise_scale
from lsvision.stages.calibration.problem import BoardProblem


@dataclass(frozen=True)
class Estimate:
    """Posteriors of a batch of problems, their noise multiplied by ``noise_scale``, 1 where it is as given."""

    posterior: Posterior
    noise_scale: Float[Tensor, "*batch"]

    def replaced(self, chosen: Bool[Tensor, "*batch"], part: "Estimate") -> "Estimate":
        """The same with the chosen problems' replaced by those of ``part``, in a row."""
        scale = _scattered(chosen, part.noise_scale, self.noise_scale)
        return Estimate(_merged(chosen, part.posterior, self.posterior), scale)


@dataclass(frozen=True)
class NoisyEstimate(Estimate):
    """Posteriors that allow for the errors along the scan that were found."""

    along_scan: ErrorsAlongScan


def estimate_with_noise(
    problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig
) -> NoisyEstimate:
    """Posteriors by the configured method; where residuals are correlated along the scan, those that allow for it."""
    found = estimate_white(problem, start, config)
    along = errors_along_scan(problem, found.posterior, found.noise_scale, config.prior_sigma, config.correlated_odds)
    if bool(along.found.any()):
        found = found.replaced(along.found, estimate_white(along.problem(problem), start[along.found], config))
    return NoisyEstimate(found.posterior, found.noise_scale, along)


def estimate_white(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Estimate:
    """Posteriors with the noise as the problem has it, or scaled up where the residuals ask for it."""
    posterior = estimate(problem, start, config)
    drifting = config.method == "sequential" and bool(config.process_sigma)  # residuals of one n are then no noise
    one = torch.ones_like(start[..., 0])
    found = Estimate(posterior, one if drifting else noise_scale(problem, posterior))
    larger = found.noise_scale > 1
    if not bool(larger.any()):
        return found
    again = estimate(problem.scaled(found.noise_scale).at(larger), start[larger], config)
    return found.replaced(larger, Estimate(again, found.noise_scale[larger]))


def _merged(chosen: Tensor, part: Posterior, whole: Posterior) -> Posterior:
    length = max(len(part.path), len(whole.path))
    paths = (torch.cat([p.path, p.path[-1:].expand(length - len(p.path), *p.path.shape[1:])]) for p in (part, whole))
    path = [_scattered(chosen, *steps) for steps in zip(*paths, strict=True)]
    names = ("mean", "factor", "iterations", "converged", "info")
    merged = {name: _scattered(chosen, getattr(part, name), getattr(whole, name)) for name in names}
    return Posterior(path=torch.stack(path), **merged)


def _scattered(chosen: Tensor, part: Tensor, whole: Tensor) -> Tensor:
    """A copy with the entries of a mask replaced by those of ``part``, in order."""
    copy = whole.clone()
    copy[chosen] = part
    return copy
