"""Methods that estimate board poses and the motion n from corners: each takes a problem and its start to a posterior.

All methods hold the prior on n (and on the poses, where one is wanted) fixed and count every corner once.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation import (
    Gaussian,
    Info,
    Linearise,
    Posterior,
    Prior,
    Rows,
    StateSpace,
    apply,
    filter_sequence,
    iterated_update,
    levenberg_marquardt,
    nees,
)
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import corner_rows, linearise, point_factor
from lsvision.stages.calibration.model import rmse, whitened_residuals
from lsvision.stages.calibration.problem import BoardProblem

# Sigma, rad or mm, of a flat prior where a filter needs a number.
_FLAT = 1e5


def estimate(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Posterior of the poses and n by the configured method."""
    return METHODS[config.method](problem, start, config)


def joint(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Iterated posterior linearisation over all corners of all boards at once."""
    return iterated_update(
        partial(linearise, problem),
        prior_about(start, config),
        Gaussian(start, point_factor(start)),
        max_iterations=config.max_iterations,
        tolerance=config.tolerance,
    )


def two_step(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Alternate the boards' poses given n (Step-I) and n given the poses (Step-II) until the RMSE is small enough.

    The covariance is that of all unknowns together at the result: that of Step-II, with the poses fixed, would claim
    directions of n that the boards cannot show.

    Source: Wang et al. 2024, Algorithm 1; its step 8 is printed with the inequality the wrong way round.
    """
    size = start.shape[-1]
    poses, motion = slice(0, size - 3), slice(size - 3, size)
    prior = prior_about(start, config)
    state, path = start, [start]
    running = rmse(problem, start) > config.two_step_threshold_mm
    iterations = torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.two_step_max_iterations):
        if not bool(running.any()):
            break
        improved = _updated_part(problem, prior, state, poses, config)  # Step-I: rotations and positions, n fixed
        improved = _updated_part(problem, prior, improved, motion, config)  # Step-II: n, the poses fixed
        state = torch.where(running[..., None], improved, state)
        path.append(state)
        iterations = iterations + running
        running = running & (rmse(problem, state) > config.two_step_threshold_mm)
    at_result = Gaussian(state, point_factor(state))
    factor = iterated_update(partial(linearise, problem), prior, at_result, max_iterations=1).factor
    return _posterior(Gaussian(state, factor), torch.stack(path), iterations, ~running)


def sequential(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Filter corner by corner, board after board in line order; n walks at random by the travel between corners.

    The result is n at the end of the last scan. Each pass filters from the same prior with the corners linearised about
    the pass before: the boards' poses do not move, so that their last state is their smoothed one.

    Corners that err together are no sequence of measurements: they are taken at once, and n stands still.
    """
    if problem.correlated is not None:
        return joint(problem, start, config)
    order = LineOrder.of(problem)
    process_chol, wide = order.process_chol(config.process_sigma or 0.0), _wide_chol(start, config)
    unit = torch.eye(3, dtype=start.dtype, device=start.device)
    mean, factor, path = start, point_factor(start), [start]
    running = torch.ones_like(start[..., 0], dtype=torch.bool)
    iterations = torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.max_iterations):
        # One pass filters the increments of the state from the pass before.
        rows = order.sort(corner_rows(problem, mean, factor))
        model = StateSpace(partial(_corner_values, rows[..., :-1]), noise_chol=unit, process_chol=process_chol)
        prior = Gaussian(start - mean, wide)
        increment = filter_sequence(model, prior, rows[..., -1], order.valid, history=False).last
        new_mean, new_factor = mean + increment.mean, increment.factor
        moved = nees(new_mean - mean, new_factor) / 2
        mean = torch.where(running[..., None], new_mean, mean)
        factor = torch.where(running[..., None, None], new_factor, factor)
        path.append(mean)
        iterations = iterations + running
        running = running & ~(moved <= config.tolerance)
        if not bool(running.any()):
            break
    return _posterior(Gaussian(mean, factor), torch.stack(path), iterations, ~running)


def least_squares(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Maximum of the posterior by Levenberg-Marquardt on the exact residuals: the reference for the other methods."""
    prior = prior_about(start, config)

    def residual(state: Tensor) -> Tensor:
        """Whitened residuals of the corners, then of the prior."""
        return torch.cat([whitened_residuals(problem, state), prior.residual(state)], dim=-1)

    solution = levenberg_marquardt(residual, start, max_iterations=config.max_iterations)
    result = Gaussian(solution.state, solution.factor)
    return _posterior(result, solution.path, solution.iterations, solution.converged)


METHODS = {"joint": joint, "two_step": two_step, "sequential": sequential, "least_squares": least_squares}


def prior_about(start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Prior:
    """The configured prior on n and on the poses about the start; its root is diagonal, zero where it is flat."""
    boards = (start.shape[-1] - 3) // 6
    pose = [1 / config.rotation_sigma_rad] * 3 + [1 / config.translation_sigma_mm] * 3
    diagonal = start.new_tensor(pose * boards + [1 / config.prior_sigma] * 3)
    return Prior(start, torch.diag(diagonal).expand(*start.shape, start.shape[-1]))


@dataclass(frozen=True)
class LineOrder:
    """The corners of all boards of a problem in the order in which they are scanned, steps first.

    Boards follow one another; corners that were not seen come last on their board and take no travel.
    """

    index: Int[Tensor, "*batch boards corners"]
    valid: Bool[Tensor, "steps *batch"]
    travel_mm: Float[Tensor, "steps *batch"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "LineOrder":
        """The order of a problem's corners, and the travel from each to the next."""
        travel = torch.where(problem.valid, problem.points[..., 1].abs(), torch.inf)
        travel, index = travel.sort(dim=-1)
        between = torch.nn.functional.pad(travel.diff(dim=-1), (1, 0)).flatten(-2).movedim(-1, 0)
        valid = _sorted(problem.valid, index)
        return cls(index, valid, torch.where(valid, between, 0.0))

    def sort(
        self, values: Float[Tensor, "*batch boards corners rows columns"]
    ) -> Float[Tensor, "steps *batch rows columns"]:
        """Values of all corners in line order."""
        return _sorted(values, self.index)

    def process_chol(self, sigma: float) -> Float[Tensor, "steps *batch state state"]:
        """√Q of an n that walks at random by ``sigma`` per square root of a mm; the poses stand still."""
        walk = sigma * self.travel_mm.sqrt()
        moving = torch.cat([walk.new_zeros(6 * self.index.shape[-2]), walk.new_ones(3)])
        return torch.diag_embed(walk[..., None] * moving)


def _sorted(values: Tensor, index: Tensor) -> Tensor:
    """``(*batch, boards, corners, ..)`` by an index ``(*batch, boards, corners)``, as ``(steps, *batch, ..)``."""
    batch = index.ndim - 2
    by_value = index.reshape(*index.shape, *(1,) * (values.ndim - index.ndim)).expand_as(values)
    return values.gather(batch + 1, by_value).flatten(batch, batch + 1).movedim(batch, 0)


def _corner_values(A: Tensor, points: Tensor, step: int) -> Tensor:
    """Linearised corner of a step; the points are copied, so that sums take one order (see ``estimation.linalg``)."""
    return apply(A[step], points.contiguous())


def _wide_chol(start: Tensor, config: CalibrationConfig) -> Tensor:
    """Cholesky factor of the prior; a flat part gets a sigma so wide that its weight is lost in rounding."""
    sigma = prior_about(start, config).root.diagonal(dim1=-2, dim2=-1).clamp(min=1 / _FLAT).reciprocal()
    return torch.diag_embed(sigma)


def _updated_part(problem: BoardProblem, prior: Prior, state: Tensor, part: slice, config: CalibrationConfig) -> Tensor:
    """The state with one part of it updated by all corners and the prior, the rest fixed."""
    posterior = iterated_update(
        _given_rest(problem, state, part),
        Prior(prior.mean[..., part], prior.root[..., part, part]),
        Gaussian(state[..., part], point_factor(state)[..., part, part]),
        max_iterations=config.max_iterations,
        tolerance=config.tolerance,
    )
    return torch.cat([state[..., : part.start], posterior.mean, state[..., part.stop :]], dim=-1)


def _given_rest(problem: BoardProblem, state: Tensor, part: slice) -> Linearise:
    """Linearisation in one part of the state, the rest fixed."""

    def rows(mean: Tensor, factor: Tensor) -> Rows:
        """Rows of the whole state, with the columns of the part alone."""
        whole_mean, whole_factor = state.clone(), point_factor(state).clone()
        whole_mean[..., part], whole_factor[..., part, part] = mean, factor
        whole = linearise(problem, whole_mean, whole_factor)
        return Rows(torch.cat([whole.matrix[..., part], whole.matrix[..., -1:]], -1), whole.log_det)

    return rows


def _posterior(result: Gaussian, path: Tensor, iterations: Tensor, converged: Tensor) -> Posterior:
    """The result with its status: singular where it is not finite."""
    finite = torch.isfinite(result.factor).all((-2, -1)) & torch.isfinite(result.mean).all(-1)
    info = torch.where(converged, int(Info.OK), int(Info.NOT_CONVERGED))
    info = torch.where(finite, info, int(Info.SINGULAR))
    return Posterior(result.mean, result.factor, path, iterations, info == int(Info.OK), info)
