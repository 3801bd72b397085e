"""Board corners -> calibration: the motion of an object under a rig, its uncertainty, and the next scan to make."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.errors import CalibrationError, ConfigError
from lsvision.estimation import Info, Posterior
from lsvision.stages.calibration.board_scale import explained_by_size, with_unknown_size
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.findings import find_flaws
from lsvision.stages.calibration.hypotheses import Known
from lsvision.stages.calibration.measurements import BoardMeasurements, SoundProblem
from lsvision.stages.calibration.methods import estimate
from lsvision.stages.calibration.misplaced import column_rows, largest_residuals
from lsvision.stages.calibration.model import rotations, squared_residuals, translations
from lsvision.stages.calibration.noise import board_chi_square, noise_scale, squared_residuals_of_boards
from lsvision.stages.calibration.observability import observe
from lsvision.stages.calibration.outliers import outlying
from lsvision.stages.calibration.problem import BoardProblem, MountingPitch
from lsvision.stages.calibration.scatter import scatter, widened
from lsvision.stages.calibration.verdict import judge, not_settled, rmse_grew
from lsvision.types import BoardCorners, BoardFit, Calibration, Iteration, Motion, Pose, Rig

__all__ = ["BatchCalibration", "CalibrationConfig", "calibrate", "calibrate_batch"]


@dataclass(frozen=True)
class BatchCalibration:
    """Calibrations of a batch of problems; a problem whose ``info`` is SINGULAR holds NaN.

    ``noise_scale`` is the factor on the given covariance that the residuals asked for, 1 where they are as expected;
    covariances include it. ``rmse_path_mm`` and ``n_path`` run by iteration from the state before (index 0), and repeat
    the result past a problem's last iteration.
    """

    n: Float[Tensor, "*batch 3"]
    covariance: Float[Tensor, "*batch 3 3"]
    rotation: Float[Tensor, "*batch boards 3 3"]
    translation_mm: Float[Tensor, "*batch boards 3"]
    rmse_path_mm: Float[Tensor, "iterations *batch"]
    n_path: Float[Tensor, "iterations *batch 3"]
    board_rmse_before_mm: Float[Tensor, "*batch boards"]
    board_rmse_after_mm: Float[Tensor, "*batch boards"]
    noise_scale: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]


def calibrate(boards: Sequence[BoardCorners], rig: Rig, config: CalibrationConfig) -> Calibration:
    """Motion n and board poses from the corners of one or more board scans.

    Args:
        boards: corners of each scan; several scans may be of one board.
        rig: the cameras that made the scans; copied into the result.

    Raises:
        CalibrationError: no boards; a board with fewer than six valid corners, corners on one line, or values or
            covariances that are not finite or not positive definite (names the scan); no solution.
        ConfigError: a mounting pitch is given for more than one board.
    """
    if not boards:
        raise CalibrationError("no board scans to calibrate from")
    measured = BoardMeasurements.of(boards)
    for flaw, flawed in measured.flaws().items():
        for board, bad in zip(boards, flawed.tolist(), strict=True):
            if bad:
                raise CalibrationError(f"{board.scan}: {flaw.value}")
    solution = _solve(measured, config)
    batch, scale = solution.summary(), float(solution.noise_scale)
    if int(batch.info) == Info.SINGULAR:
        raise CalibrationError(
            f"{', '.join(board.scan for board in boards)}: the corners do not determine the boards' poses"
        )
    observability = observe(solution.problem, solution.posterior.mean, config.prior_sigma, scale)
    iterations, converged = _iterations(batch), bool(batch.converged)
    known = Known(config.prior_sigma, config.board_scale_sigma)
    findings = find_flaws(boards, solution.problem, solution.start, solution.outlying, known)
    contradictions = [*findings.contradictions, *rmse_grew(iterations[0].rmse_mm, iterations[-1].rmse_mm)]
    judged = judge(not_settled(converged, int(batch.iterations)), contradictions, observability)
    return Calibration(
        method=config.method,
        motion=Motion(batch.n, batch.covariance),
        rmse_before_mm=iterations[0].rmse_mm,
        rmse_after_mm=iterations[-1].rmse_mm,
        iterations=iterations,
        boards=_board_fits(boards, batch, solution),
        observability=observability,
        rig=rig,
        verdict=judged.verdict,
        reasons=judged.reasons,
        notes=findings.notes,
        converged=converged,
        noise_scale=scale,
    )


def calibrate_batch(
    points: Float[Tensor, "*batch boards corners 3"],
    covariance: Float[Tensor, "*#batch boards corners 3 3"],
    board_points: Float[Tensor, "*#batch boards corners 3"],
    valid: Bool[Tensor, "*#batch boards corners"],
    config: CalibrationConfig,
) -> BatchCalibration:
    """Calibrate many independent problems of equally many boards at once.

    Args:
        points: measured (x, y = travel, z) of the corners, mm; anything where ``valid`` is false.
        covariance: of the points, mm². board_points: the corners in the board frame, mm.

    Returns:
        One calibration per problem; a flawed problem is flagged in ``info`` and changes no bit of the others.

    Raises:
        ConfigError: a mounting pitch is given for more than one board.
    """
    return _solve(BoardMeasurements(points, covariance, board_points, valid), config).summary()


@dataclass(frozen=True)
class _Solution:
    """Problems of a batch, without outlying corners, and their posteriors.

    The posteriors have the noise scaled, the problems as it was given.
    """

    problem: BoardProblem
    start: Float[Tensor, "*batch state"]
    outlying: Bool[Tensor, "*batch boards corners"]
    posterior: Posterior
    noise_scale: Float[Tensor, "*batch"]
    scatter: Float[Tensor, "*batch"]
    prior_sigma: float

    def summary(self) -> BatchCalibration:
        """The solution as motion and poses of the boards, and its path."""
        problem, posterior = self.problem, self.posterior
        singular = posterior.info == int(Info.SINGULAR)
        state = torch.where(singular[..., None], torch.nan, posterior.mean)
        path = torch.where(singular[..., None], torch.nan, posterior.path)
        squared, corners = squared_residuals(problem, path), problem.valid.sum(-1)
        board_rmse = (squared / corners).sqrt()
        motion_factor = torch.where(singular[..., None, None], torch.nan, posterior.factor[..., -3:, :])
        covariance = motion_factor @ motion_factor.mT
        if bool((self.scatter > 1).any()):
            covariance = widened(covariance, self.scatter, self.prior_sigma)
        return BatchCalibration(
            n=state[..., -3:],
            covariance=covariance,
            rotation=rotations(problem, state),
            translation_mm=translations(problem, state),
            rmse_path_mm=(squared.sum(-1) / corners.sum(-1)).sqrt(),
            n_path=path[..., -3:],
            board_rmse_before_mm=board_rmse[0],
            board_rmse_after_mm=board_rmse[-1],
            noise_scale=torch.where(singular, torch.nan, self.noise_scale),
            iterations=posterior.iterations,
            converged=posterior.converged & ~singular,
            info=posterior.info,
        )


def _solve(measured: BoardMeasurements, config: CalibrationConfig) -> _Solution:
    """The problems estimated without outlying corners, once more where their residuals ask for a larger noise."""
    config = config.resolved()
    _check(config, measured.points.shape[-3])
    posed = SoundProblem.of(measured, _mounting_pitch(config))
    off = outlying(posed.problem)
    if bool(off.any()):
        posed = SoundProblem.of(replace(measured, valid=measured.valid & ~off), _mounting_pitch(config))
    problem, start = posed.problem, posed.start
    posterior = estimate(problem, start, config)
    scale = apart = torch.ones_like(start[..., 0])
    if config.method != "sequential" or not config.process_sigma:  # residuals of an n that drifts are no noise
        by_size = explained_by_size(problem, posterior, config.board_scale_sigma)
        squared = squared_residuals_of_boards(problem, posterior)
        scale = noise_scale(problem, squared, by_size)
        if bool((scale > 1).any()):
            noisier = replace(problem, noise_chol=problem.noise_chol * scale.sqrt()[..., None, None, None, None])
            posterior = _merge(scale > 1, estimate(noisier, start, config), posterior)
            squared = squared_residuals_of_boards(problem, posterior)
        apart = scatter(problem, squared, posterior, scale, by_size, config.prior_sigma)
        posterior = with_unknown_size(problem, posterior, scale, config.board_scale_sigma)
    info = torch.where(posed.sound, posterior.info, int(Info.SINGULAR))
    return _Solution(problem, start, off, replace(posterior, info=info), scale, apart, config.prior_sigma)


def _check(config: CalibrationConfig, boards: int) -> None:
    """Raise ConfigError where an option does not fit the number of boards."""
    if config.mounting_pitch_deg is not None and boards != 1:
        raise ConfigError(f"calibration.mounting_pitch_deg: expected null, as there are {boards} board scans, not one")


def _mounting_pitch(config: CalibrationConfig) -> MountingPitch | None:
    if config.mounting_pitch_deg is None:
        return None
    return MountingPitch(math.radians(config.mounting_pitch_deg), math.radians(config.mounting_pitch_sigma_deg))


def _merge(chosen: Tensor, one: Posterior, other: Posterior) -> Posterior:
    """``one`` for the chosen problems of a batch, ``other`` for the rest."""
    length = max(len(one.path), len(other.path))
    one_path, other_path = (
        torch.cat([p.path, p.path[-1:].expand(length - len(p.path), *p.path.shape[1:])]) for p in (one, other)
    )
    return Posterior(
        torch.where(chosen[..., None], one.mean, other.mean),
        torch.where(chosen[..., None, None], one.factor, other.factor),
        torch.where(chosen[..., None], one_path, other_path),
        torch.where(chosen, one.iterations, other.iterations),
        torch.where(chosen, one.converged, other.converged),
        torch.where(chosen, one.info, other.info),
    )


def _iterations(batch: BatchCalibration) -> tuple[Iteration, ...]:
    stretch = torch.linalg.vector_norm(batch.n_path, dim=-1)
    return tuple(
        Iteration(rmse_mm, (n1, n2, n3), length)
        for rmse_mm, (n1, n2, n3), length in zip(
            batch.rmse_path_mm.tolist(), batch.n_path.tolist(), stretch.tolist(), strict=True
        )
    )


def _board_fits(boards: Sequence[BoardCorners], batch: BatchCalibration, solution: _Solution) -> tuple[BoardFit, ...]:
    problem = solution.problem
    chi_square = board_chi_square(problem, solution.posterior)
    largest = largest_residuals(problem, solution.posterior.mean)
    return tuple(
        BoardFit(
            scan=board.scan,
            corners=int(problem.valid[i].sum()),
            pose=Pose(batch.rotation[i], batch.translation_mm[i]),
            rmse_before_mm=float(batch.board_rmse_before_mm[i]),
            rmse_after_mm=float(batch.board_rmse_after_mm[i]),
            reduced_chi_square=float(chi_square[i]),
            outliers=column_rows(board.board_points, solution.outlying[i, : len(board.valid)]),
            largest_residual=largest[i],
        )
        for i, board in enumerate(boards)
    )
