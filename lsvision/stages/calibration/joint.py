"""The joint calibration: all corners of all boards at once, and a covariance that covers where the model is curved."""

from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import Gaussian, Info, Posterior, Prior, iterated_update, lower_factor
from lsvision.stages.calibration.chosen import merged
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import linearise, point_factor
from lsvision.stages.calibration.mode import Mode, find_mode, gauss_newton_step, rows_of
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.turn import is_curved, spread_along_turn

_ROUNDING = 1e-12  # nats: a step that is shorter says nothing


@dataclass(frozen=True)
class Covering:
    """Factors of covariances that cover the results' errors, and where such a factor was found."""

    factor: Float[Tensor, "*batch state columns"]
    found: Bool[Tensor, "*batch"]


def joint(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Iterated posterior linearisation over all corners of all boards at once.

    Where that does not settle, or leaves the rotations so open that no linearisation holds, the result is the mode of
    the posterior instead, with the second moment about it; see ``turn``.
    """
    return posterior_from(problem, prior_about(start, config), start, config)


def posterior_from(
    problem: BoardProblem, prior: Prior, begin: Float[Tensor, "*batch state"], config: CalibrationConfig
) -> Posterior:
    """``joint`` under a given prior, from a given state on."""
    found = iterated_update(
        partial(linearise, problem),
        prior,
        Gaussian(begin, point_factor(begin)),
        max_iterations=config.max_iterations,
        tolerance=config.tolerance,
    )
    doubtful = ~found.converged | is_curved(problem, found.factor)
    if not bool(doubtful.any()):
        return found
    chosen = Prior(prior.mean[doubtful], prior.root.expand(*begin.shape, -1)[doubtful])
    return merged(doubtful, _by_mode(problem.at(doubtful), chosen, begin[doubtful], config), found)


def mode_of(
    problem: BoardProblem, prior: Prior, begin: Float[Tensor, "*batch state"], config: CalibrationConfig
) -> Mode:
    """The mode of the posterior, within the options' iterations and tolerance."""
    distance = (2 * max(config.tolerance, _ROUNDING)) ** 0.5
    return find_mode(problem, rows_of(prior), begin, config.max_iterations, distance)


def moved_to(state: Float[Tensor, "*batch state"], posterior: Posterior) -> Float[Tensor, "*batch state state"]:
    """Factor of the second moment of a posterior about another state than its own, lower triangular."""
    return lower_factor(torch.cat([posterior.factor, (posterior.mean - state)[..., None]], dim=-1))


def covering(
    problem: BoardProblem, prior: Prior, result: Gaussian, walk: Float[Tensor, "*batch state columns"],
    config: CalibrationConfig,
) -> Covering:  # fmt: skip
    """Factors for results whose own hold where the model is straight alone, and whether they cover.

    Where it is curved it is the second moment of the joint posterior about the result.

    Args:
        walk: factor of what is known less well by the method than by the joint one.
    """
    curved = is_curved(problem, result.factor)
    factor, found = result.factor.clone(), torch.ones_like(curved)
    if bool(curved.any()):
        chosen = Prior(prior.mean[curved], prior.root.expand(*prior.mean.shape, -1)[curved])
        begin = result.mean[curved]
        by_all = posterior_from(problem.at(curved), chosen, begin, config)
        factor[curved] = lower_factor(torch.cat([moved_to(begin, by_all), walk[curved]], dim=-1))
        found[curved] = by_all.converged
    return Covering(factor, found)


def widened_where_open(
    problem: BoardProblem, prior: Prior, result: Gaussian, converged: Bool[Tensor, "*batch"]
) -> Gaussian:
    """A result with the step that is missing in the covariance of those problems that have not converged."""
    if bool(converged.all()):
        return result
    step = gauss_newton_step(problem, rows_of(prior), result.mean)
    return replace(result, factor=torch.where(converged[..., None, None], result.factor, step.widened_factor))


def _by_mode(problem: BoardProblem, prior: Prior, begin: Tensor, config: CalibrationConfig) -> Posterior:
    """The mode with the second moment about it; the best state on the way to it where it was not found."""
    mode, further = mode_of(problem, prior, begin, config), rows_of(prior)
    spread = spread_along_turn(problem, further, mode)
    first, last = gauss_newton_step(problem, further, begin), mode.here
    better = last.cost <= first.cost  # not so where the last is not finite
    state = torch.where(better[..., None], mode.state, begin)
    open_end = torch.where(better[..., None, None], last.widened_factor, first.widened_factor)
    factor = torch.where(spread.found[..., None, None], spread.factor, open_end)
    path = torch.cat([mode.path[:-1], state[None]])
    info = torch.where(spread.found, int(Info.OK), int(Info.NOT_CONVERGED))
    return Posterior(state, factor, path, mode.iterations, spread.found, info)
