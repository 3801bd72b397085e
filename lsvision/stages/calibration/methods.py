"""Methods that estimate board poses and the motion n from corners: each takes a problem and its start to a posterior.

All methods hold the prior on n (and on the poses, where one is wanted) fixed and count every corner once.
"""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import (
    Info,
    Posterior,
    Rows,
    apply,
    filter_sequence,
    iterated_update,
    levenberg_marquardt,
    nees,
)
from lsvision.estimation.joint import Linearise
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.model import (
    POINT_SPREAD,
    BoardProblem,
    corner_rows,
    linearise,
    squared_residuals,
    whitened_residuals,
)

# Standard deviation, rad or mm, of a flat prior where a filter needs a number.
_FLAT = 1e5


def estimate(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Posterior of the poses and n by the configured method."""
    return METHODS[config.method](problem, start, config)


def joint(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Iterated posterior linearisation over all corners of all boards at once."""
    return iterated_update(
        partial(linearise, problem),
        start,
        prior_root(start, config),
        start,
        _point(start),
        max_iterations=config.max_iterations,
        tolerance=config.tolerance,
    )


def two_step(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Alternate the boards' poses given n (Step-I) and n given the poses (Step-II) until the RMSE is small enough.

    The covariance is that of all unknowns together at the result: Step-II's own, with the poses held fixed, would claim
    directions of n that the boards cannot show.

    Source: Wang et al. 2024, Algorithm 1; its step 8 is printed with the inequality the wrong way round.
    """
    poses, motion = slice(0, start.shape[-1] - 3), slice(start.shape[-1] - 3, start.shape[-1])
    state, path = start, [start]
    running = rmse(problem, start) > config.two_step_threshold_mm
    iterations = torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.two_step_max_iterations):
        if not bool(running.any()):
            break
        after_poses = _update_part(problem, state, start, poses, config)
        after_motion = _update_part(problem, after_poses, start, motion, config)
        state = torch.where(running[..., None], after_motion, state)
        path.append(state)
        iterations = iterations + running
        running = running & (rmse(problem, state) > config.two_step_threshold_mm)
    factor = _joint_factor(problem, state, prior_root(start, config))
    info = torch.where(running, int(Info.NOT_CONVERGED), int(Info.OK))
    info = torch.where(torch.isfinite(factor).all((-2, -1)) & torch.isfinite(state).all(-1), info, int(Info.SINGULAR))
    return Posterior(state, factor, torch.stack(path), iterations, info == int(Info.OK), info)


def sequential(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Filter corner by corner, board after board in line order; n walks at random by the travel between corners.

    The result is n at the end of the last scan. Each pass filters from the same prior with the corners linearised about
    the pass before: the boards' poses do not move, so that their last state is their smoothed one.
    """
    rows_order, valid, process = _line_order(problem, config.process_sigma or 0.0)
    mean, factor, path = start, _point(start), [start]
    running = torch.ones_like(start[..., 0], dtype=torch.bool)
    iterations = torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.max_iterations):
        rows = rows_order(corner_rows(problem, mean, factor))
        track = filter_sequence(
            partial(_corner_values, rows[..., :-1]),
            start - mean,
            _wide_chol(start, config),
            rows[..., -1],
            torch.eye(3, dtype=start.dtype, device=start.device),
            process,
            valid=valid,
            history=False,
        )
        new_mean, new_factor = mean + track.means[-1], track.factors[-1]
        moved = nees(new_mean - mean, new_factor) / 2
        mean = torch.where(running[..., None], new_mean, mean)
        factor = torch.where(running[..., None, None], new_factor, factor)
        path.append(mean)
        iterations = iterations + running
        running = running & ~(moved <= config.tolerance)
        if not bool(running.any()):
            break
    info = torch.where(running, int(Info.NOT_CONVERGED), int(Info.OK))
    info = torch.where(torch.isfinite(mean).all(-1), info, int(Info.SINGULAR))
    return Posterior(mean, factor, torch.stack(path), iterations, info == int(Info.OK), info)


def least_squares(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Maximum of the posterior by Levenberg-Marquardt on the exact residuals: the reference for the other methods."""
    root = prior_root(start, config)

    def residual(state: Tensor) -> Tensor:
        from_prior = apply(root, state - start)
        return torch.cat([whitened_residuals(problem, state), from_prior], dim=-1)

    solution = levenberg_marquardt(residual, start, max_iterations=config.max_iterations)
    info = torch.where(solution.converged, int(Info.OK), int(Info.NOT_CONVERGED))
    info = torch.where(torch.isfinite(solution.factor).all((-2, -1)), info, int(Info.SINGULAR))
    return Posterior(solution.state, solution.factor, solution.path, solution.iterations, solution.converged, info)


def prior_root(start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Float[Tensor, "*batch state state"]:
    """Information root of the prior: diagonal, zero for what is flat."""
    boards = (start.shape[-1] - 3) // 6
    pose = [1 / config.rotation_sigma_rad] * 3 + [1 / config.translation_sigma_mm] * 3
    diagonal = start.new_tensor(pose * boards + [1 / config.prior_sigma] * 3)
    return torch.diag(diagonal).expand(*start.shape, start.shape[-1])


def rmse(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch"]:
    """Root-mean-square residual over all corners of all boards, mm."""
    squared = squared_residuals(problem, state).sum(-1)
    return (squared / problem.valid.sum((-2, -1))).sqrt()


METHODS = {"joint": joint, "two_step": two_step, "sequential": sequential, "least_squares": least_squares}


def _update_part(problem: BoardProblem, state: Tensor, start: Tensor, part: slice, config: CalibrationConfig) -> Tensor:
    """The state with one part of it updated by all corners, the rest held; the prior is that of the start."""
    root = prior_root(start, config)[..., part, part]
    held = _given_rest(problem, state, part)
    mean, spread = state[..., part], _point(state)[..., part, part]
    posterior = iterated_update(
        held, start[..., part], root, mean, spread, max_iterations=config.max_iterations, tolerance=config.tolerance
    )
    return torch.cat([state[..., : part.start], posterior.mean, state[..., part.stop :]], dim=-1)


def _given_rest(problem: BoardProblem, state: Tensor, part: slice) -> Linearise:
    """Linearisation in one part of the state, the rest known to be what it is."""

    def rows(mean: Tensor, factor: Tensor) -> Rows:
        """Rows of the whole state, as seen by the part."""
        full, spread = state.clone(), _point(state).clone()
        full[..., part], spread[..., part, part] = mean, factor
        whole = linearise(problem, full, spread)
        return Rows(torch.cat([whole.matrix[..., part], whole.matrix[..., -1:]], -1), whole.log_det)

    return rows


def _line_order(problem: BoardProblem, sigma: float) -> tuple[Callable[[Tensor], Tensor], Tensor, Tensor]:
    """How to put corners, ``(*batch, boards, corners, ..)``, in line order, steps first; which are valid; √Q of n.

    Corners that were not seen come last on their board and take no travel.
    """
    travel = torch.where(problem.valid, problem.points[..., 1].abs(), torch.inf)
    travel, order = travel.sort(dim=-1)
    batch = problem.valid.ndim - 2

    def reorder(values: Tensor) -> Tensor:
        index = order.reshape(*order.shape, *(1,) * (values.ndim - order.ndim)).expand_as(values)
        return values.gather(batch + 1, index).flatten(batch, batch + 1).movedim(batch, 0)

    valid = reorder(problem.valid)
    between = torch.nn.functional.pad(travel.diff(dim=-1), (1, 0)).flatten(-2).movedim(-1, 0)
    spread = sigma * torch.where(valid, between, 0.0).sqrt()
    moving = torch.cat([spread.new_zeros(6 * problem.boards), spread.new_ones(3)])
    return reorder, valid, torch.diag_embed(spread[..., None] * moving)


def _corner_values(A: Tensor, points: Tensor, step: int) -> Tensor:
    """Linearised corner of a step; the points are copied so that sums run alike for one problem and for many."""
    return apply(A[step], points.contiguous())


def _wide_chol(start: Tensor, config: CalibrationConfig) -> Tensor:
    """Cholesky factor of the prior; what is flat becomes so wide that its weight is lost in rounding."""
    spread = prior_root(start, config).diagonal(dim1=-2, dim2=-1).clamp(min=1 / _FLAT).reciprocal()
    return torch.diag_embed(spread)


def _joint_factor(problem: BoardProblem, state: Tensor, root: Tensor) -> Tensor:
    """Covariance factor of all unknowns, the model linearised at a point."""
    return iterated_update(partial(linearise, problem), state, root, state, _point(state), max_iterations=1).factor


def _point(state: Tensor) -> Tensor:
    """Factor of a Gaussian so narrow that linearising about it is linearising at its mean."""
    eye = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device)
    return (POINT_SPREAD * eye).expand(*state.shape, state.shape[-1])
