"""The paper's calibration: poses given n, then n given the poses, in turns.

Travel is counted from the middle of each board. An error of n then leaves the middle where it is, and n and the
positions hardly depend on each other: the RMSE falls to a third an iteration. Counted from the first line of a scan,
as it is measured, it falls by a seventh.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import Gaussian, Info, Posterior, Prior, Rows, iterated_update
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.joint import moved_to, posterior_from
from lsvision.stages.calibration.linearise import linearise, point_factor
from lsvision.stages.calibration.mode import gauss_newton_step, rows_of
from lsvision.stages.calibration.model import rmse
from lsvision.stages.calibration.noise import noise_scale, squared_residuals_of_boards
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.stages.calibration.reduction import CorrelatedNoise

# A result may be this far, in nats, from where one joint step of Gauss-Newton leads: a sigma of all unknowns together.
_SETTLED = 0.5
_JOINT_ITERATIONS = 20  # of the joint calibration behind the covariance, however few the options allow the result


def two_step(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Alternate the boards' poses given n (Step-I) and n given the poses (Step-II) until the RMSE stands still.

    It has converged where one joint step from its result would gain little. Its covariance is that of the joint
    calibration and the square of the distance to that: of all unknowns together, as that of Step-II, with the poses
    fixed, would claim directions of n that the boards cannot show; and of what the iteration still lacks. How well each
    coordinate of a corner is known, and noise that is correlated along the scan, count in the covariance alone: the
    paper weighs all corners of a board alike, each by itself.

    Source: Wang et al. 2024, Algorithm 1; its step 8 is printed with the inequality the wrong way round.
    """
    plain = replace(problem, correlated=None)
    prior, middles = prior_about(start, config), Middles.of(_weighed_alike(plain))
    state, path, before = start, [start], rmse(problem, start)
    running = before > config.two_step_threshold_mm
    iterations = torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.two_step_max_iterations):
        if not bool(running.any()):
            break
        improved = middles.count(state)
        for part in (slice(0, -3), slice(-3, None)):  # Step-I: rotations and positions, n fixed; Step-II: n
            improved = _updated_part(middles, prior, improved, part, config)
        state = torch.where(running[..., None], middles.count_not(improved), state)
        path.append(state)
        iterations, after = iterations + running, rmse(problem, state)
        still = (before - after).abs() <= config.two_step_tolerance * before
        running, before = running & ~still & (after > config.two_step_threshold_mm), after
    reached = gauss_newton_step(_as_scattered(plain, state), rows_of(prior), state)
    by_all = posterior_from(problem, prior, state, replace(config, max_iterations=_JOINT_ITERATIONS))
    converged = (reached.distance.square() / 2 <= _SETTLED) & by_all.converged
    factor = moved_to(state, by_all)
    finite = torch.isfinite(factor).all((-2, -1)) & torch.isfinite(state).all(-1)
    info = torch.where(converged, int(Info.OK), int(Info.NOT_CONVERGED))
    info = torch.where(finite, info, int(Info.SINGULAR))
    return Posterior(state, factor, torch.stack(path), iterations, info == int(Info.OK), info)


@dataclass(frozen=True)
class Middles:
    """A problem whose travel is counted from the middle of each board, ``travel`` mm behind the first line.

    A board's position is then where it lies when its middle is scanned, its position at travel zero less travel · n.
    The rows of the problem on its affine maps are counted so, which linearisation takes, and not its points.
    """

    problem: BoardProblem
    travel: Float[Tensor, "*batch boards"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "Middles":
        """A problem counted from its boards' middles."""
        seen = problem.valid.to(problem.points)
        travel = (seen * problem.points[..., 1]).sum(-1) / seen.sum(-1)
        rows = problem.affine_rows.clone()
        rows[..., -1] -= travel[..., None] * rows[..., 1]  # whose second column is on the travel at p = 0
        return cls(replace(problem, correlated=CorrelatedNoise(rows, problem.noise_log_det)), travel)

    def count(self, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state"]:
        """A state of the problem as it was, in positions when the middles are scanned."""
        return self._shifted(state, -1.0)

    def count_not(self, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state"]:
        """The inverse of ``count``."""
        return self._shifted(state, 1.0)

    def rows(self, rows: Float[Tensor, "*batch rows columns"]) -> Float[Tensor, "*batch rows columns"]:
        """Rows ``[A | r]`` on a state of the problem as it was, as rows on one that is counted from the middles."""
        by_pose, by_motion, residual = rows[..., :-4], rows[..., -4:-1], rows[..., -1:]
        by_position = by_pose.unflatten(-1, (-1, 6))[..., 3:]
        moved = by_position.transpose(-1, -2) * self.travel[..., None, None, :]
        by_motion = by_motion + moved.contiguous().sum(-1)
        return torch.cat([by_pose, by_motion, residual], dim=-1)

    def _shifted(self, state: Tensor, sign: float) -> Tensor:
        parts = BoardState.split(state)
        position = parts.position + sign * self.travel[..., None] * parts.n[..., None, :]
        return replace(parts, position=position).join()


def _weighed_alike(problem: BoardProblem) -> BoardProblem:
    """The problem with the mean variance of all coordinates of a board's corners in place of each."""
    seen = problem.valid.to(problem.points)
    variance = problem.noise_chol.square().sum((-2, -1)) / 3.0
    mean = (seen * variance).sum(-1) / seen.sum(-1)
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device)
    alike = mean.sqrt()[..., None, None, None] * eye
    return replace(problem, noise_chol=alike.expand_as(problem.noise_chol))


def _as_scattered(problem: BoardProblem, state: Tensor) -> BoardProblem:
    """The problem with its noise as large as the residuals: a step is long or short against that."""
    squared = squared_residuals_of_boards(problem, state)
    return problem.scaled(noise_scale(problem, squared, torch.zeros_like(squared[..., 0])))


def _updated_part(middles: Middles, prior: Prior, state: Tensor, part: slice, config: CalibrationConfig) -> Tensor:
    """The state with one part of it updated by all corners and the prior, the rest fixed; counted from the middles."""

    def rows(moved: Tensor, factor: Tensor) -> Rows:
        """Rows of corners and prior on the part alone, about one value of it."""
        there, narrow = state.clone(), point_factor(state).clone()
        there[..., part], narrow[..., part, part] = moved, factor
        corners = linearise(middles.problem, there, narrow)
        by_prior = middles.rows(rows_of(prior)(middles.count_not(there)))
        both = torch.cat([corners.matrix, by_prior], dim=-2)
        return Rows(torch.cat([both[..., :-1][..., part], both[..., -1:]], -1), corners.log_det)

    begin = state[..., part]
    posterior = iterated_update(
        rows,
        Prior(begin, begin.new_zeros(*begin.shape, begin.shape[-1])),  # the true one is among the rows
        Gaussian(begin, point_factor(state)[..., part, part]),
        max_iterations=config.max_iterations,
        tolerance=config.tolerance,
    )
    updated = state.clone()
    updated[..., part] = posterior.mean
    return updated
