"""Board corners -> calibration: the motion of an object under a rig, its uncertainty, and the next scan to make."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import CalibrationError, ConfigError
from lsvision.estimation import Info, Posterior
from lsvision.geometry import sharp_depth_mm
from lsvision.stages.calibration.along_scan import ErrorsAlongScan
from lsvision.stages.calibration.batch import BatchCalibration, errors_along_scan_of, iterations_of
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.exchanged import images_exchanged
from lsvision.stages.calibration.findings import find_flaws
from lsvision.stages.calibration.hypotheses import Assumed
from lsvision.stages.calibration.measurements import BoardMeasurements, SoundProblem
from lsvision.stages.calibration.misplaced import column_rows, largest_residuals
from lsvision.stages.calibration.model import refitted, rotations, squared_residuals, translations
from lsvision.stages.calibration.noise import board_chi_square
from lsvision.stages.calibration.observability import Known, observe
from lsvision.stages.calibration.outliers import outlying
from lsvision.stages.calibration.problem import BoardProblem, MountingPitch
from lsvision.stages.calibration.scatter import widened
from lsvision.stages.calibration.solution import estimate_with_noise
from lsvision.stages.calibration.verdict import UNLIKE, judge, not_settled, rmse_grew
from lsvision.types import BoardCorners, BoardFit, Calibration, Motion, Pose, Rig

__all__ = ["BatchCalibration", "CalibrationConfig", "calibrate", "calibrate_batch"]


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
    assumed = Assumed(config.prior_sigma, config.board_scale_sigma)
    shaken = bool(solution.along_scan.found)
    findings = find_flaws(boards, solution.problem, solution.start, solution.outlying, assumed, shaken)
    if findings.contradictions and shaken:  # they are no errors along the scan
        solution = _solve(measured, replace(config, correlated_odds=math.inf))
    batch, scale = solution.summary(), float(solution.noise_scale)
    if int(batch.info) == Info.SINGULAR:
        raise CalibrationError(
            f"{', '.join(board.scan for board in boards)}: the corners do not determine the boards' poses"
        )
    depth_mm = config.depth_range_mm or sharp_depth_mm(rig)
    known = Known(batch.covariance, config.prior_sigma, scale, depth_mm)
    observability = observe(solution.weighed, solution.posterior.mean, known)
    iterations, converged = iterations_of(batch), bool(batch.converged)
    before_mm, after_mm = iterations[0].rmse_mm, iterations[-1].rmse_mm
    along_scan = errors_along_scan_of(batch)
    contradictions = [*findings.contradictions, *rmse_grew(before_mm, after_mm)]
    if bool(batch.along_scan_unlike) and not contradictions:
        contradictions.append(UNLIKE)
    if scale > 1 or along_scan:  # where the residuals are no noise as stated
        contradictions = images_exchanged(boards, rig, config, after_mm) or contradictions
    judged = judge(not_settled(converged, int(batch.iterations)), contradictions, observability)
    return Calibration(
        method=config.method,
        motion=Motion(batch.n, batch.covariance),
        rmse_before_mm=before_mm,
        rmse_after_mm=after_mm,
        iterations=iterations,
        boards=_board_fits(boards, batch, solution),
        observability=observability,
        rig=rig,
        verdict=judged.verdict,
        reasons=judged.reasons,
        notes=findings.notes if along_scan else (*findings.notes, *findings.shake),
        converged=converged,
        noise_scale=scale,
        errors_along_scan=along_scan,
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

    The posteriors have the noise scaled and allow for the errors ``along_scan``; the problems have it as given.
    ``scatter`` is that between the boards.
    """

    problem: BoardProblem
    start: Float[Tensor, "*batch state"]
    outlying: Bool[Tensor, "*batch boards corners"]
    posterior: Posterior
    noise_scale: Float[Tensor, "*batch"]
    scatter: Float[Tensor, "*batch"]
    along_scan: ErrorsAlongScan
    config: CalibrationConfig

    @property
    def weighed(self) -> BoardProblem:
        """The problems with the noise that the posteriors allow for, but for its scale."""
        return replace(self.problem, correlated=self.along_scan.noise)

    def summary(self) -> BatchCalibration:
        """The solution as motion and poses of the boards, and its path."""
        problem, posterior = self.problem, self.posterior
        singular = posterior.info == int(Info.SINGULAR)
        state = torch.where(singular[..., None], torch.nan, posterior.mean)
        path = torch.where(singular[..., None], torch.nan, posterior.path)
        squared, corners = self._squared_residuals(path), problem.valid.sum(-1)
        board_rmse = (squared / corners).sqrt()
        motion_factor = torch.where(singular[..., None, None], torch.nan, posterior.factor[..., -3:, :])
        covariance = motion_factor @ motion_factor.mT
        if bool((self.scatter > 1).any()):
            covariance = widened(covariance, self.scatter, self.config.prior_sigma)
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
            along_scan_rms_mm=self.along_scan.rms_mm,
            along_scan_length_mm=self.along_scan.length_mm,
            along_scan_unlike=self.along_scan.unlike,
            iterations=posterior.iterations,
            converged=posterior.converged & ~singular,
            info=posterior.info,
        )

    def _squared_residuals(self, path: Tensor) -> Tensor:
        """Sums by iteration and board, mm²; errors along the scan are no fault of n, and poses take what they can.

        The two-step scheme gives all corners one weight: its poses have taken it.
        """
        squared, found = squared_residuals(self.problem, path), self.along_scan.found
        if bool(found.any()) and self.config.method != "two_step":
            shaken = self.problem.at(found)
            squared[:, found] = squared_residuals(shaken, refitted(shaken, path[:, found]))
        return squared


def _solve(measured: BoardMeasurements, config: CalibrationConfig) -> _Solution:
    """The problems estimated without outlying corners, and with the noise that the others' residuals ask for."""
    config = config.resolved()
    _check(config, measured.points.shape[-3])
    posed = SoundProblem.of(measured, _mounting_pitch(config))
    drifts = config.method == "sequential" and bool(config.process_sigma)  # no affine map fits where n walks
    off = torch.zeros_like(posed.problem.valid) if drifts else outlying(posed.problem)
    if bool(off.any()):
        posed = SoundProblem.of(replace(measured, valid=measured.valid & ~off), _mounting_pitch(config))
    found = estimate_with_noise(posed.problem, posed.start, config)
    info = torch.where(posed.sound, found.posterior.info, int(Info.SINGULAR))
    return _Solution(
        posed.problem,
        posed.start,
        off,
        replace(found.posterior, info=info),
        found.noise_scale,
        found.scatter,
        found.along_scan,
        config,
    )


def _check(config: CalibrationConfig, boards: int) -> None:
    """Raise ConfigError where an option does not fit the number of boards."""
    if config.mounting_pitch_deg is not None and boards != 1:
        raise ConfigError(f"calibration.mounting_pitch_deg: expected null, as there are {boards} board scans, not one")


def _mounting_pitch(config: CalibrationConfig) -> MountingPitch | None:
    if config.mounting_pitch_deg is None:
        return None
    return MountingPitch(math.radians(config.mounting_pitch_deg), math.radians(config.mounting_pitch_sigma_deg))


def _board_fits(boards: Sequence[BoardCorners], batch: BatchCalibration, solution: _Solution) -> tuple[BoardFit, ...]:
    problem, state = solution.problem, solution.posterior.mean
    chi_square, largest = board_chi_square(problem, state), largest_residuals(problem, state)
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
