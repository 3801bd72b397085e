"""Board corners -> calibration: the motion of an object under a rig, how well it is known, and what to scan next."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.errors import CalibrationError, ConfigError
from lsvision.estimation import Info, Posterior
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.methods import estimate
from lsvision.stages.calibration.model import (
    BoardProblem,
    MountingPitch,
    linearise,
    nominal_problem,
    rotations,
    squared_residuals,
    translations,
)
from lsvision.stages.calibration.observability import observe
from lsvision.types import BoardCorners, BoardFit, Calibration, Iteration, Motion, Rig

__all__ = ["BatchCalibration", "CalibrationConfig", "calibrate", "calibrate_batch"]

# Three times six measured values for the nine unknowns of one board.
MIN_CORNERS = 6
# Corners whose scatter across a line is this small a part of that along it fix no rotation about it.
_COLLINEAR = 1e-3
# Residuals that the given covariance would show with less than this probability make the noise be scaled up.
_NOISE_TEST_LEVEL = 1e-3


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
        boards: corners of each scan; a board may stand in several scans.
        rig: the cameras that made the scans; carried into the result.

    Raises:
        CalibrationError: no boards; a board with fewer than six valid corners, corners on one line, or values or
            covariances that are not finite or not positive definite (names the scan); no solution.
        ConfigError: a mounting pitch is given for more than one board.
    """
    if not boards:
        raise CalibrationError("no board scans to calibrate from")
    points, covariance, board_points, valid = _stacked(boards)
    for reason, flawed in _flaws(points, covariance, board_points, valid).items():
        for board, bad in zip(boards, flawed.tolist(), strict=True):
            if bad:
                raise CalibrationError(f"{board.scan}: {reason}")
    problem, posterior, scale, batch = _solve(points, covariance, board_points, valid, config)
    if int(batch.info) == Info.SINGULAR:
        raise CalibrationError(
            f"{', '.join(board.scan for board in boards)}: the corners do not determine the boards' poses"
        )
    return Calibration(
        method=config.method,
        motion=Motion(batch.n, batch.covariance),
        rmse_before_mm=float(batch.rmse_path_mm[0]),
        rmse_after_mm=float(batch.rmse_path_mm[-1]),
        iterations=_iterations(batch),
        boards=_board_fits(boards, batch),
        observability=observe(problem, posterior.mean, config.prior_sigma, float(scale)),
        rig=rig,
        converged=bool(batch.converged),
        noise_scale=float(scale),
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
        One calibration a problem; a flawed problem is flagged in ``info`` and changes no bit of the others.

    Raises:
        ConfigError: a mounting pitch is given for more than one board.
    """
    return _solve(points, covariance, board_points, valid, config)[3]


def _solve(
    points: Tensor, covariance: Tensor, board_points: Tensor, valid: Tensor, config: CalibrationConfig
) -> tuple[BoardProblem, Posterior, Tensor, BatchCalibration]:
    """Problem, posterior, noise scale and summary of a batch."""
    config = config.resolved()
    _check(config, points.shape[-3])
    problem, start, sound = _sound_problem(points, covariance, board_points, valid, _mounting_pitch(config))
    posterior = estimate(problem, start, config)
    drifting = config.method == "sequential" and bool(config.process_sigma)  # what one n leaves over is then no noise
    scale = torch.ones_like(start[..., 0]) if drifting else _noise_scale(problem, posterior)
    if bool((scale > 1).any()):
        noisier = replace(problem, noise_chol=problem.noise_chol * scale.sqrt()[..., None, None, None, None])
        posterior = _merge(scale > 1, estimate(noisier, start, config), posterior)
    info = torch.where(sound, posterior.info, int(Info.SINGULAR))
    return problem, posterior, scale, _summary(problem, replace(posterior, info=info), scale)


def _stacked(boards: Sequence[BoardCorners]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, covariance, board points and validity of all boards, the shorter ones padded with corners not seen."""
    corners = max(board.points.shape[0] for board in boards)

    def pad(tensor: Tensor) -> Tensor:
        return torch.cat([tensor, tensor.new_zeros(corners - tensor.shape[0], *tensor.shape[1:])])

    fields = ([getattr(board, name) for board in boards] for name in ("points", "covariance", "board_points", "valid"))
    points, covariance, board_points, valid = (torch.stack([pad(tensor) for tensor in field]) for field in fields)
    return points, covariance, board_points, valid


def _flaws(points: Tensor, covariance: Tensor, board_points: Tensor, valid: Tensor) -> dict[str, Tensor]:
    """By reason, the boards ``(*batch, boards)`` that nothing can be computed from."""
    finite = torch.isfinite(points).all(-1) & torch.isfinite(board_points).all(-1)
    covariance_finite = torch.isfinite(covariance).all((-2, -1))
    positive = torch.linalg.cholesky_ex(torch.where(covariance_finite[..., None, None], covariance, 0.0)).info == 0
    seen = valid & finite
    collinear = _collinear(points, seen) | _collinear(board_points, seen)
    return {
        f"fewer than {MIN_CORNERS} valid corners": valid.sum(-1) < MIN_CORNERS,
        "a valid corner's point is not finite": (valid & ~finite).any(-1),
        "a valid corner's covariance is not finite": (valid & ~covariance_finite).any(-1),
        "a valid corner's covariance is not positive definite": (valid & ~positive).any(-1),
        "the valid corners lie on one line": collinear,
    }


def _collinear(points: Tensor, seen: Tensor) -> Tensor:
    weight = seen.to(points) / seen.sum(-1, keepdim=True).clamp(min=1)
    known = torch.where(seen[..., None], points, 0.0)
    centered = torch.where(seen[..., None], known - (weight[..., None] * known).sum(-2, keepdim=True), 0.0)
    scatter = torch.linalg.eigvalsh(centered.mT @ centered)
    return scatter[..., 1] <= _COLLINEAR**2 * scatter[..., 2]


def _check(config: CalibrationConfig, boards: int) -> None:
    """Raise ConfigError where an option does not fit the number of boards."""
    if config.mounting_pitch_deg is not None and boards != 1:
        raise ConfigError(f"calibration.mounting_pitch_deg: expected null, as there are {boards} board scans, not one")


def _mounting_pitch(config: CalibrationConfig) -> MountingPitch | None:
    if config.mounting_pitch_deg is None:
        return None
    return MountingPitch(math.radians(config.mounting_pitch_deg), math.radians(config.mounting_pitch_sigma_deg))


def _sound_problem(
    points: Tensor, covariance: Tensor, board_points: Tensor, valid: Tensor, pitch: MountingPitch | None
) -> tuple[BoardProblem, Tensor, Tensor]:
    """The problem, its start, and which of the batch are sound; the others are replaced by a harmless stand-in."""
    sound = ~reduce(torch.logical_or, _flaws(points, covariance, board_points, valid).values()).any(-1)
    keep, seen = sound[..., None, None], valid & sound[..., None, None]
    # Factored as few times as it was given: boards of one batch mostly share their noise.
    chol = torch.linalg.cholesky_ex(covariance).L.expand(*points.shape, 3)
    if bool(seen.all()):  # nothing to stand in for, and nothing to copy
        problem, start = nominal_problem(points, chol, board_points.expand(points.shape), seen, pitch)
        return problem, start, sound
    index = torch.arange(points.shape[-2], dtype=points.dtype, device=points.device)
    stand_in = torch.stack([index, index * index, torch.zeros_like(index)], dim=-1)
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    points = torch.where(seen[..., None], points, torch.where(keep[..., None], 0.0, stand_in))
    board_points = torch.where(seen[..., None], board_points, torch.where(keep[..., None], 0.0, stand_in))
    chol = torch.where(seen[..., None, None], chol, eye)
    problem, start = nominal_problem(points, chol, board_points, seen | ~keep, pitch)
    return problem, start, sound


def _noise_scale(problem: BoardProblem, posterior: Posterior) -> Tensor:
    """Reduced chi-square of the residuals where they are larger than chance allows, else 1.

    They are weighed with the linearisation's error as well: where n is known from its prior alone, the mean of the
    posterior does not lie on the curve of poses and n that fit.
    """
    corners_alone = problem if problem.pitch is None else replace(problem, pitch=None)
    rows = linearise(corners_alone, posterior.mean, posterior.factor)
    squared = rows.matrix[..., -1].square().sum(-1)
    freedom = 3.0 * problem.valid.sum((-2, -1)) - posterior.mean.shape[-1]
    unlikely = torch.special.gammaincc(freedom / 2, squared / 2) < _NOISE_TEST_LEVEL
    return torch.where(unlikely, squared / freedom, 1.0)


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


def _summary(problem: BoardProblem, posterior: Posterior, scale: Tensor) -> BatchCalibration:
    singular = posterior.info == int(Info.SINGULAR)
    state = torch.where(singular[..., None], torch.nan, posterior.mean)
    path = torch.where(singular[..., None], torch.nan, posterior.path)
    squared, corners = squared_residuals(problem, path), problem.valid.sum(-1)
    board_rmse = (squared / corners).sqrt()
    motion_factor = torch.where(singular[..., None, None], torch.nan, posterior.factor[..., -3:, :])
    return BatchCalibration(
        n=state[..., -3:],
        covariance=motion_factor @ motion_factor.mT,
        rotation=rotations(problem, state),
        translation_mm=translations(problem, state),
        rmse_path_mm=(squared.sum(-1) / corners.sum(-1)).sqrt(),
        n_path=path[..., -3:],
        board_rmse_before_mm=board_rmse[0],
        board_rmse_after_mm=board_rmse[-1],
        noise_scale=torch.where(singular, torch.nan, scale),
        iterations=posterior.iterations,
        converged=posterior.converged & ~singular,
        info=posterior.info,
    )


def _iterations(batch: BatchCalibration) -> tuple[Iteration, ...]:
    stretch = torch.linalg.vector_norm(batch.n_path, dim=-1)
    return tuple(
        Iteration(rmse_mm, (n1, n2, n3), length)
        for rmse_mm, (n1, n2, n3), length in zip(
            batch.rmse_path_mm.tolist(), batch.n_path.tolist(), stretch.tolist(), strict=True
        )
    )


def _board_fits(boards: Sequence[BoardCorners], batch: BatchCalibration) -> tuple[BoardFit, ...]:
    return tuple(
        BoardFit(
            scan=board.scan,
            corners=int(board.valid.sum()),
            rotation=batch.rotation[i],
            translation_mm=batch.translation_mm[i],
            rmse_before_mm=float(batch.board_rmse_before_mm[i]),
            rmse_after_mm=float(batch.board_rmse_after_mm[i]),
        )
        for i, board in enumerate(boards)
    )
