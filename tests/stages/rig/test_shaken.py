"""Boards that shook: the rig comes out as well as its sigmas say, and the motion of the lines is named."""

from dataclasses import dataclass, replace

import pytest
import torch

from lsvision.estimation import mean_chi_square_band
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import QUANTITIES, Shared
from lsvision.stages.rig.shaken import allow_for_line_motion
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.stages.rig.solve import RigSolution, SharedErrors, solve_rig
from lsvision.study.rig_scans import RigConditions
from lsvision.study.shaken import Motion, Vibration
from lsvision.study.shaken_rigs import ShakenBoards
from lsvision.types import RIG_QUANTITIES, Board
from tests.stages.rig.boards import CONFIG, DATA_SHEET, PRIOR

BOARD = Board(12, 9, 30.0)
WAVES_MM = (233.0, 97.0, 61.0)
USUAL = RigConditions(boards=8)
N_AND_SCALE = [*range(QUANTITIES, QUANTITIES + 3), RIG_QUANTITIES.index("baseline_mm")]


@dataclass(frozen=True)
class ShakenRig:
    """A true rig, what it sees of boards that shake, and the rig that is found without and with their motion."""

    truth: Shared
    sightings: Sightings

    @classmethod
    def drawn(cls, seed: int, motion: Motion | None = None) -> "ShakenRig":
        """One whose truth is drawn from the prior, planes of view some millimetres apart."""
        torch.manual_seed(seed)
        truth = PRIOR.shared(torch.randn(QUANTITIES + 3, dtype=torch.float64))
        chance = torch.Generator().manual_seed(seed)
        motion = motion or Vibration.drawn((0.5, 0.5, 3.5e-4), WAVES_MM, USUAL.boards, chance)
        return cls(truth, ShakenBoards.placed(DATA_SHEET, truth, BOARD, USUAL, motion).sightings(USUAL))

    def found(self) -> RigSolution:
        """The rig with the motion of the lines."""
        return allow_for_line_motion(solve_rig(self.sightings, PRIOR, CONFIG), self.sightings, CONFIG).solution

    def squared_error(self, solution: RigSolution, quantities: list[int]) -> float:
        """Normalised by the covariance that is stated."""
        error = (solution.shared.vector - self.truth.vector)[quantities]
        return float(error @ torch.linalg.solve(solution.covariance[quantities][:, quantities], error))

    def bend_over_stated(self, solution: RigSolution) -> float:
        """The rms bend of heights, over what is stated."""
        shape = HeightShape.of(DATA_SHEET, self.truth, PRIOR.sigma, 52.0)
        error = PRIOR.over_sigma(solution.shared.vector - self.truth.vector)
        return float(shape.bend_mm(error) / shape.stated_mm(solution.factor))


@pytest.mark.slow
def test_errors_of_shaken_rigs_are_as_large_as_stated():
    """Of n and the scale and of all quantities, at most what chance allows the mean of so many once in 200 times."""
    rigs = [ShakenRig.drawn(seed) for seed in range(40, 46)]
    found = [rig.found() for rig in rigs]
    for quantities in (N_AND_SCALE, list(range(QUANTITIES + 3))):
        errors = [rig.squared_error(solution, quantities) for rig, solution in zip(rigs, found, strict=True)]
        least, most = mean_chi_square_band(len(quantities), len(rigs), 0.99)
        assert least < sum(errors) / len(errors) < most
    bends = [rig.bend_over_stated(solution) for rig, solution in zip(rigs, found, strict=True)]
    assert max(bends) < 2.5
    assert all(int(solution.outliers.sum()) < 20 for solution in found)
    assert max(float(solution.noise_scale) for solution in found) < 1.1


@pytest.mark.slow
def test_shaken_boards_calibrate_a_rig():
    rig = ShakenRig.drawn(0)
    found = calibrate_rig(rig.sightings, [f"s{i}" for i in range(8)], DATA_SHEET, CONFIG)
    assert found.noise_scale < 1.1
    assert found.verdict in ("determined", "prior-dominated")
    by_component = {error.component: error for error in found.errors_along_scan}
    assert by_component.keys() >= {"x", "z"}
    assert all(0.3 < by_component[component].rms_mm < 0.7 for component in "xz")


@pytest.mark.slow
def test_no_corner_is_an_outlier_because_its_line_moved():
    """But those that lie off what their line moved by are left out."""
    rig = ShakenRig.drawn(1)
    sightings = rig.sightings
    wrong = torch.zeros_like(sightings.valid)
    wrong[::2, 5::17] = True
    position = sightings.left.position + torch.where(wrong[..., None], torch.tensor([1.5, 0.1]).double(), 0.0)
    sightings = replace(sightings, left=CameraSighting(position, sightings.left.factor))
    white = solve_rig(sightings, PRIOR, CONFIG)
    shaken = allow_for_line_motion(white, sightings, CONFIG).solution
    assert int(white.outliers.sum()) > 50
    left_out = sightings.valid & ~shaken.sightings.valid
    assert bool(left_out[wrong].all())
    assert int((left_out & ~wrong).sum()) < 20
    assert torch.equal(shaken.outliers, left_out.sum(-1))
    assert rig.squared_error(shaken, N_AND_SCALE) < 25.0  # of 4 degrees of freedom once in 20 000


def test_shared_errors_whiten_as_the_factor_of_their_covariance_does():
    chance = torch.Generator().manual_seed(2)
    by_latents = torch.randn(2, 20, 3, generator=chance, dtype=torch.float64)
    residuals = torch.randn(2, 5, 4, generator=chance, dtype=torch.float64)
    factor = torch.linalg.cholesky(torch.eye(20, dtype=torch.float64) + by_latents @ by_latents.mT)
    expected = torch.linalg.solve_triangular(factor, residuals.flatten(1)[..., None], upper=False)
    found = SharedErrors.of(by_latents).whitened(residuals)
    torch.testing.assert_close(found.square().sum((1, 2)), expected.square().sum((1, 2)))
    torch.testing.assert_close(SharedErrors.of(1e-9 * by_latents).whitened(residuals), residuals)
