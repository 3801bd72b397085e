"""Boards that shook: the motion of their lines, marginalised in the estimate of the rig.

What displaces all corners of a line together is found as the calibration of n finds it: a Gaussian process along the
travel for each of its components, of the kernels that the corners give evidence for, by points that the rig found so
far measures. Each camera sees the object displaced by what its own line says. Columns and travels are linear in it to a
hundredth of a pixel, so that the corners of a board have one covariance,

    S = I + Z Zᵀ,     Z = C⁻¹ J W F,

in sigmas: C the factor of a corner's covariance, J the derivative of where a camera sees a point by (x, travel, z), W F
the processes at the camera's own lines. The rig is fitted again with it, twice, as the first one is bent by the motion.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.geometry import RawPair
from lsvision.stages.calibration.along_scan import COMPONENTS, FINE, Travel, latents
from lsvision.stages.calibration.batch import errors_along_scan_of
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.stages.calibration.solved import Solution, solve
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.stages.rig.solve import RigSolution, fit_rig, noise_scale_of
from lsvision.types import ErrorAlongScan

_ROUNDS = 2
_SUSPECT = 1.2  # noise scale from which lines may have moved
_MOST_OUTLIERS = 0.02  # of the corners: more were left out because a model without motion does not fit


@dataclass(frozen=True)
class ShakenSolution:
    """A solution that allows for the motion of the lines, and what that motion is."""

    solution: RigSolution
    errors: tuple[ErrorAlongScan, ...]


def allow_for_line_motion(solution: RigSolution, sightings: Sightings, config: RigConfig) -> ShakenSolution:
    """The solution of one problem again, with the motion of its boards' lines where the corners show one.

    Args:
        sightings: all corners: those that a vibration displaces most are no outliers.
    """
    errors: tuple[ErrorAlongScan, ...] = ()
    if float(solution.noise_scale) < _SUSPECT or not bool(solution.found.converged):
        return ShakenSolution(solution, errors)
    still = solution
    if int(still.outliers.sum()) > _MOST_OUTLIERS * int(sightings.valid.sum()):
        solution = replace(still, sightings=sightings, outliers=torch.zeros_like(still.outliers))
    for _ in range(_ROUNDS):
        options = CalibrationConfig(prior_sigma=config.motion_sigma, correlated_odds=config.correlated_odds)
        by_points = solve(_measured(solution), options)
        if not bool(by_points.along_scan.found):
            break
        errors = errors_along_scan_of(by_points.summary())
        solution = _without_left_out(solution, by_points)
        solution = _fitted_again(solution, _along(solution, by_points), config)
    return ShakenSolution(solution if errors else still, errors)


def _without_left_out(solution: RigSolution, by_points: Solution) -> RigSolution:
    """The solution less the corners that the search for the motion left out: it says nothing of how they moved."""
    left_out = solution.sightings.valid & ~by_points.problem.valid
    kept = replace(solution.sightings, valid=solution.sightings.valid & ~left_out)
    return replace(solution, sightings=kept, outliers=solution.outliers + left_out.sum(-1))


def _fitted_again(solution: RigSolution, along: Float[Tensor, "boards rows rows"], config: RigConfig) -> RigSolution:
    kept, one = solution.sightings, torch.ones_like(solution.sightings.left.position[..., 0])
    state = fit_rig(solution.model, kept, solution.found.state, one, config, along).state
    scale = noise_scale_of(replace(solution, found=replace(solution.found, state=state), along=along).whitened, kept)
    found = fit_rig(solution.model, kept, state, one / scale, config, along)
    return replace(solution, found=found, noise_scale=scale, along=along)


def _measured(solution: RigSolution) -> BoardMeasurements:
    """The corners as (x, travel, z) by the rig as it was found, travel that of the left camera."""
    pair, n = _pair(solution), solution.shared.n
    left, right = solution.sightings.left, solution.sightings.right

    def points(move: Tensor) -> Tensor:
        met = pair.meet(left.position[..., 0] + move[0], right.position[..., 0] + move[2], n)
        return torch.stack([met.x, left.position[..., 1] + move[1], met.z], dim=-1)

    still = left.position.new_zeros(3)
    by_left, by_right = jacobian(points, still).split([2, 1], dim=-1)
    roots = torch.cat([by_left @ left.factor, by_right @ right.factor[..., :1, :]], dim=-1)
    at = points(still)
    board = solution.sightings.board_points.expand_as(at)
    return BoardMeasurements(at, roots @ roots.mT, board, solution.sightings.valid)


def _along(solution: RigSolution, by_points: Solution) -> Float[Tensor, "boards rows rows"]:
    """Factor of the covariance of each board's residuals, in sigmas."""
    roots = covariance_root(by_points.along_scan.spectrum.covariance(FINE))[None]
    rows = torch.cat(
        [
            _by_latents(solution, by_points, eye, by_place, roots)
            for eye, by_place in zip(
                (solution.sightings.left, solution.sightings.right), _by_displacement(solution), strict=True
            )
        ],
        dim=-2,
    )
    rows = torch.where(solution.sightings.valid[..., None, None], rows, 0.0).flatten(1, 2)
    eye = torch.eye(rows.shape[-2], dtype=rows.dtype)
    return torch.linalg.cholesky(eye + rows @ rows.mT)


def _by_latents(
    solution: RigSolution, by_points: Solution, eye: CameraSighting, by_place: Tensor, roots: Tensor
) -> Float[Tensor, "boards corners 2 latents"]:
    """What the latents of the processes do to one camera's sightings, in sigmas."""
    problem = by_points.problem
    x, _, z = problem.points.unbind(-1)
    seen = replace(problem, points=torch.stack([x, eye.position[..., 1], z], dim=-1))
    displaced = latents(seen, roots, FINE, Travel.of(problem))
    return torch.linalg.solve_triangular(eye.factor, by_place @ displaced, upper=False)


def _by_displacement(solution: RigSolution) -> list[Float[Tensor, "boards corners 2 3"]]:
    """The derivative of (column, travel) of either camera by a displacement (x, travel, z) of the line."""
    pair, n, model = _pair(solution), solution.shared.n, solution.model
    points = model.placed(solution.found.state)

    def seen(move: Tensor) -> Tensor:
        moved = points + torch.stack([move[0], move.new_zeros(()), move[2]])
        both = [camera(moved, n) for camera in (pair.seen_left, pair.seen_right)]
        return torch.stack([torch.stack([eye.column, eye.travel + move[1]], dim=-1) for eye in both])

    return list(jacobian(seen, points.new_zeros(len(COMPONENTS) - 1)).unbind(0))


def _pair(solution: RigSolution) -> RawPair:
    return RawPair.of(solution.model.prior.rig, solution.shared.quantities)
