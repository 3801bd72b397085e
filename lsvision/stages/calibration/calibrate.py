"""Board corners -> calibration: the motion of an object under a rig, its uncertainty, and the next scan to make."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import CalibrationError
from lsvision.estimation import Info
from lsvision.geometry import sharp_depth_mm
from lsvision.stages.calibration.along_scan.seen_later import SeenLater
from lsvision.stages.calibration.batch import BatchCalibration, errors_along_scan_of, iterations_of
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.exchanged import images_exchanged
from lsvision.stages.calibration.findings import Findings, find_flaws
from lsvision.stages.calibration.hypotheses import Assumed
from lsvision.stages.calibration.line_motion import FoundProcesses, line_motions
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.stages.calibration.misplaced import column_rows, largest_residuals
from lsvision.stages.calibration.noise import board_chi_square
from lsvision.stages.calibration.observability import Known, observe
from lsvision.stages.calibration.readmitted import solve_readmitting
from lsvision.stages.calibration.rig_errors import motion_by_rig, widened_by_rig
from lsvision.stages.calibration.solved import Solution, solve
from lsvision.stages.calibration.verdict import UNLIKE, judge, not_settled, rmse_grew
from lsvision.stages.calibration.with_edges import with_edges
from lsvision.types import BoardCorners, BoardEdges, BoardFit, Calibration, LineMotion, Motion, Pose, Rig

__all__ = ["BatchCalibration", "CalibrationConfig", "calibrate", "calibrate_batch", "calibrate_edges"]


def calibrate(
    boards: Sequence[BoardCorners],
    rig: Rig,
    config: CalibrationConfig,
    edges: Sequence[BoardEdges | None] | None = None,
) -> Calibration:
    """Motion n and board poses from the corners of one or more board scans.

    Args:
        boards: corners of each scan; several scans may be of one board.
        rig: the cameras that made the scans; copied into the result.
        edges: of the squares of each board, on every line. They are used where the corners show that the boards shook:
            what the lines did is then known between the corners too.

    Raises:
        CalibrationError: no boards; a board with fewer than six valid corners, corners on one line, or values or
            covariances that are not finite or not positive definite (names the scan); no solution.
        ConfigError: a mounting pitch is given for more than one board.
    """
    found = _explained(boards, edges, rig, config)
    solution, findings = found.solution, found.findings
    batch, scale = solution.summary(), float(solution.noise_scale)
    if int(batch.info) == Info.SINGULAR:
        raise CalibrationError(
            f"{', '.join(board.scan for board in boards)}: the corners do not determine the boards' poses"
        )
    depth_mm = config.depth_range_mm or sharp_depth_mm(rig)
    covariance, by_rig = widened_by_rig(batch.covariance, motion_by_rig(boards, solution, config))
    known = Known(covariance, config.prior_sigma, scale, depth_mm)
    observability = observe(solution.weighed, solution.posterior.mean, known)
    iterations, converged = iterations_of(batch), bool(batch.converged)
    before_mm, after_mm = iterations[0].rmse_mm, iterations[-1].rmse_mm
    along_scan = errors_along_scan_of(batch)
    contradictions = [*findings.contradictions, *rmse_grew(before_mm, after_mm)]
    if bool(batch.along_scan_unlike) and not contradictions:
        contradictions.append(UNLIKE)
    if scale > 1 or along_scan:  # where the residuals are no noise as stated
        as_they_are_mm = float(solution.rmse_with_lines_as_they_are())
        contradictions = images_exchanged(boards, rig, config, as_they_are_mm) or contradictions
    motions = _line_motions(boards, batch, solution, rig) if along_scan and not contradictions else ()
    judged = judge(not_settled(converged, int(batch.iterations)), contradictions, observability)
    return Calibration(
        method=config.method,
        motion=Motion(batch.n, covariance),
        rmse_before_mm=before_mm,
        rmse_after_mm=after_mm,
        iterations=iterations,
        boards=_board_fits(boards, batch, solution, motions),
        line_motions=motions,
        observability=observability,
        rig=rig,
        verdict=judged.verdict,
        reasons=judged.reasons,
        notes=(*findings.notes, *by_rig, *(found.by_edges if along_scan else findings.shake)),
        converged=converged,
        noise_scale=scale,
        errors_along_scan=along_scan,
    )


@dataclass(frozen=True)
class _Explained:
    """A solution with the cause that explains its residuals best, and what the edges did to it, in sentences."""

    solution: Solution
    findings: Findings
    by_edges: tuple[str, ...] = ()


def _explained(
    boards: Sequence[BoardCorners], edges: Sequence[BoardEdges | None] | None, rig: Rig, config: CalibrationConfig
) -> _Explained:
    """Solve, with errors along the scan only where no other cause explains the residuals, then with the edges."""
    measured = _sound(boards)
    solution = solve_readmitting(measured, config)
    assumed = Assumed(config.prior_sigma, config.board_scale_sigma)
    shaken = bool(solution.along_scan.found)
    findings = find_flaws(boards, solution.problem, solution.start, solution.outlying, assumed, shaken)
    if findings.contradictions and shaken:  # they are no errors along the scan
        solution = solve(measured, replace(config, correlated_odds=math.inf))
        shaken = bool(solution.along_scan.found)
    if not shaken or edges is None or not config.corrects_lines:
        return _Explained(solution, findings)
    by_edges = with_edges(solution, edges, SeenLater.of(boards, rig))
    return _Explained(by_edges, findings, _what_edges_did(solution, by_edges))


def _sound(boards: Sequence[BoardCorners]) -> BoardMeasurements:
    """The corners of all boards.

    Raises:
        CalibrationError: there are none, or a board cannot be used; names the scan.
    """
    if not boards:
        raise CalibrationError("no board scans to calibrate from")
    measured = BoardMeasurements.of(boards)
    for flaw, flawed in measured.flaws().items():
        for board, bad in zip(boards, flawed.tolist(), strict=True):
            if bad:
                raise CalibrationError(f"{board.scan}: {flaw.value}")
    return measured


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
    return solve(BoardMeasurements(points, covariance, board_points, valid), config).summary()


def calibrate_edges(
    measured: BoardMeasurements, edges: Sequence[BoardEdges | None], config: CalibrationConfig
) -> BatchCalibration:
    """Calibrate one problem, with the edges of its boards where its corners show that they shook.

    Raises:
        ConfigError: a mounting pitch is given for more than one board.
    """
    solution = solve(measured, config)
    shaken = bool(solution.along_scan.found) and config.corrects_lines
    return (with_edges(solution, edges) if shaken else solution).summary()


def _what_edges_did(before: Solution, after: Solution) -> tuple[str, ...]:
    """The sentence on what the edges made of the sigma of n; nothing where no edges were found."""
    if after.edges is None:
        return ()
    sigmas = (solution.posterior.factor[-3:].square().sum(-1).sqrt().tolist() for solution in (before, after))
    words = (", ".join(f"{value:.1e}" for value in sigma) for sigma in sigmas)
    return (f"the edges of the squares, on every line, bring the sigmas of n from {next(words)} to {next(words)}",)


def _line_motions(
    boards: Sequence[BoardCorners], batch: BatchCalibration, solution: Solution, rig: Rig
) -> tuple[LineMotion, ...]:
    """The motion from line to line of every scan; none where it is not asked for or the lines are not known."""
    travels = [board.travel_mm for board in boards if board.travel_mm is not None]
    if not solution.config.corrects_lines or len(travels) < len(boards):
        return ()
    reach = torch.stack([torch.stack(travel.aminmax()) for travel in travels])
    parts = (batch.along_scan_rms_mm, batch.along_scan_length_mm, solution.along_scan.log_ratio)
    found = FoundProcesses(solution.processes((), reach), *parts, solution.config.correlated_odds)
    return line_motions(found, travels, rig)


def _board_fits(
    boards: Sequence[BoardCorners], batch: BatchCalibration, solution: Solution, motions: Sequence[LineMotion]
) -> tuple[BoardFit, ...]:
    problem, state = solution.steadied, solution.posterior.mean
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
            line_motion=motions[i].findings if motions else (),
        )
        for i, board in enumerate(boards)
    )
