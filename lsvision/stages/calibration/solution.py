"""Posteriors of a batch of problems, with the noise that their residuals ask for: as given, larger, or correlated."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import Posterior
from lsvision.stages.calibration.chosen import merged, scattered
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.correlated import ErrorsAlongScan, errors_along_scan
from lsvision.stages.calibration.methods import estimate
from lsvision.stages.calibration.noise import drifting_noise_scale, noise_scale
from lsvision.stages.calibration.problem import BoardProblem


@dataclass(frozen=True)
class Estimate:
    """Posteriors of a batch of problems, their noise multiplied by ``noise_scale``, 1 where it is as given."""

    posterior: Posterior
    noise_scale: Float[Tensor, "*batch"]

    def replaced(self, chosen: Bool[Tensor, "*batch"], part: "Estimate") -> "Estimate":
        """The same with the chosen problems' replaced by those of ``part``, in a row."""
        scale = scattered(chosen, part.noise_scale, self.noise_scale)
        return Estimate(merged(chosen, part.posterior, self.posterior), scale)


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
    if config.method == "sequential" and config.process_sigma and problem.correlated is None:
        found = Estimate(posterior, drifting_noise_scale(problem, start, posterior.mean, config))
    else:
        found = Estimate(posterior, noise_scale(problem, posterior.mean))
    larger = found.noise_scale > 1
    if not bool(larger.any()):
        return found
    again = estimate(problem.scaled(found.noise_scale).at(larger), start[larger], config)
    return found.replaced(larger, Estimate(again, found.noise_scale[larger]))
