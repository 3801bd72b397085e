"""Problems solved: without outlying corners, with the noise that the residuals ask for, the motion of lines known."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.estimation import Info, Posterior, product
from lsvision.stages.calibration.along_scan import (
    EdgeRows,
    ErrorsAlongScan,
    Linearised,
    Processes,
    processes_given_corners,
)
from lsvision.stages.calibration.batch import BatchCalibration
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements, SoundProblem
from lsvision.stages.calibration.model import refitted, rmse, rotations, squared_residuals, translations
from lsvision.stages.calibration.outliers import outlying
from lsvision.stages.calibration.problem import BoardProblem, MountingPitch
from lsvision.stages.calibration.scatter import widened
from lsvision.stages.calibration.solution import estimate_with_noise


@dataclass(frozen=True)
class Solution:
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
    edges: EdgeRows | None = None

    @property
    def weighed(self) -> BoardProblem:
        """The problems with the noise that the posteriors allow for, but for its scale."""
        return replace(self.problem, correlated=self.along_scan.noise)

    @cached_property
    def steadied(self) -> BoardProblem:
        """The problems with their corners where they would have been measured without the motion of their lines."""
        if not self.config.corrects_lines or not bool(self.along_scan.found.any()):
            return self.problem
        points = self.problem.points.clone()
        for place in self._found():
            problem = self.problem.at(place)
            moved = self.processes(place).displaced(problem.points)
            points[place] -= torch.where(problem.valid[..., None], moved, 0.0)
        return replace(self.problem, points=points)

    def processes(self, place: tuple[int, ...], reach: Float[Tensor, "boards 2"] | None = None) -> Processes:
        """The errors along the scans of one problem, of which some were found.

        Args:
            reach: least and greatest travel of each scan, mm; that of the corners if None.
        """
        problem, scale = self.problem.at(place), self.noise_scale[place]
        linearised = Linearised.of(problem, self.posterior.mean[place], self.config.prior_sigma)
        return processes_given_corners(
            problem.scaled(scale), linearised, self.along_scan.spectrum.at(place), reach, self.edges
        )

    def rmse_with_lines_as_they_are(self) -> Float[Tensor, "*batch"]:
        """RMSE, mm, at the solution, the motion of the lines not taken away."""
        return rmse(self.problem, refitted(self.problem, self.posterior.mean))

    def _found(self) -> Iterator[tuple[int, ...]]:
        """Places of the problems with errors along the scans."""
        return (tuple(index.tolist()) for index in self.along_scan.found.nonzero())

    def summary(self) -> BatchCalibration:
        """The solution as motion and poses of the boards, and its path."""
        problem, posterior = self.problem, self.posterior
        singular = posterior.info == int(Info.SINGULAR)
        state = torch.where(singular[..., None], torch.nan, posterior.mean)
        path = torch.where(singular[..., None], torch.nan, posterior.path)
        squared, corners = self._squared_residuals(path), problem.valid.sum(-1)
        board_rmse = (squared / corners).sqrt()
        motion_factor = torch.where(singular[..., None, None], torch.nan, posterior.factor[..., -3:, :])
        covariance = product(motion_factor, motion_factor.mT)
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

        The two-step scheme gives all corners one weight: its poses have taken it. Where the motion of the lines is part
        of the result, it is taken away from the first iteration on.
        """
        squared, found = squared_residuals(self.problem, path), self.along_scan.found
        if bool(found.any()) and self.config.method != "two_step":
            shaken, steadied = self.problem.at(found), self.steadied.at(found)
            by_iteration = [shaken, *[steadied] * (len(path) - 1)]
            parts = zip(by_iteration, path[:, found], strict=True)
            squared[:, found] = torch.stack([squared_residuals(part, refitted(part, state)) for part, state in parts])
        return squared


def solve(
    measured: BoardMeasurements, config: CalibrationConfig, off: Bool[Tensor, "*batch boards corners"] | None = None
) -> Solution:
    """The problems estimated without outlying corners, and with the noise that the others' residuals ask for.

    Args:
        off: corners to leave out; those that are found to lie off if None.
    """
    config = config.resolved()
    _check(config, measured.points.shape[-3])
    posed = SoundProblem.of(measured, _mounting_pitch(config))
    drifts = config.method == "sequential" and bool(config.process_sigma)  # no affine map fits where n walks
    if off is None:
        off = torch.zeros_like(posed.problem.valid) if drifts else outlying(posed.problem)
    if bool(off.any()):
        posed = SoundProblem.of(replace(measured, valid=measured.valid & ~off), _mounting_pitch(config))
    found = estimate_with_noise(posed.problem, posed.start, config)
    info = torch.where(posed.sound, found.posterior.info, int(Info.SINGULAR))
    return Solution(
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
