"""Boards that shook: the motion of their lines, marginalised in the estimate of the rig.

Whether the boards shook, the calibration of n decides, by points that the rig found so far measures. What moved their
lines is then found as it finds it where edges show it: by the spectrum, of kernels and waves, of the greatest
restricted likelihood of the corners in both images, poses, rig and motion marginalised. The rig is fitted again with
it, more than once, as the first one is bent by the motion. A corner is left out where it lies off what its line moved
by.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import jacobian, lower_factor
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan import FINE, FoundErrors, most_probable_errors
from lsvision.stages.calibration.along_scan.kernels import SEARCHED, wave_length
from lsvision.stages.calibration.along_scan.search import evidence_of
from lsvision.stages.calibration.batch import named_errors
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.stages.calibration.solved import solve
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.line_rows import LARGEST_SHARE, LineRows
from lsvision.stages.rig.sightings import Sightings
from lsvision.stages.rig.solve import (
    RigSolution,
    SharedErrors,
    fit_rig,
    near_corners,
    noise_scale_of,
    typical_scale,
)
from lsvision.types import ErrorAlongScan

_WINDOWS = 11  # sizes tried
_NOTICED = 1.02  # scale of the noise from which the corners are weighed anew
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
    if float(solution.noise_scale) < _SUSPECT or not bool(solution.found.converged):
        return ShakenSolution(solution, ())
    now = solution
    if int(solution.outliers.sum()) > _MOST_OUTLIERS * int(sightings.valid.sum()):
        now = _keeping(solution, sightings, sightings.valid)
    options = CalibrationConfig(prior_sigma=config.motion_sigma, correlated_odds=config.correlated_odds)
    by_points = solve(_measured(now), options)
    if not bool(by_points.along_scan.found):
        return ShakenSolution(solution, ())
    now = _keeping(now, sightings, now.sightings.valid & by_points.problem.valid)
    found = _Found.of(LineRows.of(now, sightings), config)
    now = _keeping(found.solution, sightings, found.not_off(sightings, config))
    found = _Found.of(LineRows.of(now, sightings), config, found)
    return ShakenSolution(found.solution, found.named)


def _keeping(solution: RigSolution, sightings: Sightings, kept: Bool[Tensor, "boards corners"]) -> RigSolution:
    """The solution with some of all its corners, before it is fitted to them."""
    return replace(solution, sightings=replace(sightings, valid=kept), outliers=(sightings.valid & ~kept).sum(-1))


@dataclass(frozen=True)
class _Found:
    """The motion of the lines about a rig, ``window`` the corners' as of ``LineRows``, and the rig fitted with it."""

    errors: FoundErrors
    window: float
    length_mm: Float[Tensor, " components"]
    solution: RigSolution

    @classmethod
    def of(cls, lines: LineRows, config: RigConfig, before: "_Found | None" = None) -> "_Found":
        """Those about the solution that rows were made about, from what was found before."""
        window = 0.0 if before is None else before.window
        near = None if before is None else before.errors.spectrum
        errors = most_probable_errors(lines.equations(window), near)
        window = _likeliest_window(lines, errors)
        errors = most_probable_errors(lines.equations(window), errors.spectrum)
        length_mm = wave_length(errors.covariance(SEARCHED)) * lines.travel.extent_mm
        return cls(errors, window, length_mm, _fitted_again(lines, errors, window, config))

    @property
    def named(self) -> tuple[ErrorAlongScan, ...]:
        """The motion in words."""
        return named_errors(self.errors.rms_mm, self.length_mm)

    def not_off(self, sightings: Sightings, config: RigConfig) -> Bool[Tensor, "boards corners"]:
        """Which of all corners lie where the motion of their lines puts them, as those that were kept show it."""
        lines, roots = LineRows.of(self.solution, sightings), covariance_root(self.errors.covariance(FINE))
        kept = self.solution.sightings.valid
        everywhere, there = (lines.by_latents(roots, which, self.window) for which in (lines.seen, kept))
        eye = torch.eye(there.shape[-1], dtype=there.dtype)
        latent = torch.linalg.solve(eye + there.mT @ there, there.mT @ lines.residuals.flatten(1)[..., None])
        square = (lines.residuals - (everywhere @ latent).unflatten(1, (-1, 4))[..., 0]).square().sum(-1)
        return near_corners(lines.seen, square.sqrt() <= config.outlier_sigma * typical_scale(square, kept))


def _likeliest_window(lines: LineRows, errors: FoundErrors) -> float:
    """The size of windows that makes the corners most probable under a spectrum."""
    covariance = errors.covariance(FINE)
    tried = torch.linspace(0.0, LARGEST_SHARE, _WINDOWS, dtype=torch.float64)
    evidence = torch.tensor([evidence_of(lines.equations(float(share)), covariance) for share in tried])
    return float(tried[evidence.argmax()])


def _fitted_again(lines: LineRows, errors: FoundErrors, window: float, config: RigConfig) -> RigSolution:
    """The solution with its corners weighed by the processes of a spectrum, which is itself known as errors say."""
    solution = lines.solution
    kept, one = solution.sightings, torch.ones_like(solution.sightings.left.position[..., 0])
    along = SharedErrors.of(lines.by_latents(covariance_root(errors.covariance(FINE)), kept.valid, window))
    found = fit_rig(solution.model, kept, solution.found.state, one, config, along)
    scale = noise_scale_of(replace(solution, found=found, along=along).whitened, kept)
    if float(scale) > _NOTICED:
        found = fit_rig(solution.model, kept, found.state, one / scale, config, along)
    factor = lower_factor(torch.cat([found.factor, errors.factor_of_shared], dim=-1))
    return replace(solution, found=replace(found, factor=factor), noise_scale=scale, along=along)


def _measured(solution: RigSolution) -> BoardMeasurements:
    """The corners as (x, travel, z) by the rig as it was found, travel that of the left camera."""
    pair, n = solution.pair, solution.shared.n
    left, right = solution.sightings.left, solution.sightings.right

    def points(move: Tensor) -> Float[Tensor, "boards corners 3"]:
        met = pair.meet(left.position[..., 0] + move[0], right.position[..., 0] + move[2], n)
        return torch.stack([met.x, left.position[..., 1] + move[1], met.z], dim=-1)

    still = left.position.new_zeros(3)
    by_left, by_right = jacobian(points, still).split([2, 1], dim=-1)
    roots = torch.cat([by_left @ left.factor, by_right @ right.factor[..., :1, :]], dim=-1)
    at = points(still)
    board = solution.sightings.board_points.expand_as(at)
    return BoardMeasurements(at, roots @ roots.mT, board, solution.sightings.valid)
