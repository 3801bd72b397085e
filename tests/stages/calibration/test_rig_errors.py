"""n by a raw rig that was calibrated itself: its sigmas cover the errors of the rig."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lsvision.estimation import mean_chi_square_band
from lsvision.geometry import ideal_rig, quantities_of, with_covariance, with_quantities
from lsvision.image.board.refine import DetectedCorners
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.corners.find import LocatedCorners, measure_corners
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.model import QUANTITIES, Shared
from lsvision.stages.rig.sightings import CameraSighting
from lsvision.study.rig_scans import RigConditions, board_poses, scanned
from lsvision.types import RIG_QUANTITIES, BoardCorners, Calibration, RawRig, Scan, StereoPair, TensorImage, Travel
from tests.stages.rig.boards import BOARD, CONFIG, DATA_SHEET, Truth, first_of

PITCH = 0.07
BLANK = TensorImage(torch.zeros(8, 1, 1, dtype=torch.uint8))


def located(eye: CameraSighting, valid: torch.Tensor) -> DetectedCorners:
    """What an image would have shown of a board, lines for travels."""
    to_lines = torch.tensor([1.0, 1 / PITCH], dtype=torch.float64)
    factor = to_lines[:, None] * eye.factor
    return DetectedCorners(eye.position * to_lines, factor @ factor.mT, valid)


def measured(truth: Truth, rig: RawRig, n: torch.Tensor) -> list[BoardCorners]:
    """Four boards that a true rig scans, by another."""
    conditions = RigConditions(boards=4, tilt_deg=5.0, sideways=0.3, depth_mm=10.0)
    shared = Shared(truth.quantities[:1, None], truth.n[:1, None])
    seen = first_of(scanned(DATA_SHEET, shared, board_poses(DATA_SHEET, BOARD, conditions, 1), BOARD, conditions))
    scan = Scan(Path("s"), ideal_rig(rig), Travel(PITCH), StereoPair(BLANK, BLANK), raw_rig=rig)
    boards = []
    for i, valid in enumerate(seen.valid):
        eyes = [located(CameraSighting(eye.position[i], eye.factor[i]), valid) for eye in (seen.left, seen.right)]
        found = measure_corners(scan, BOARD, LocatedCorners(*eyes), CornersConfig(), n)
        boards.append(replace(found, scan=f"s{i}"))
    return boards


def nees(calibration: Calibration, n: torch.Tensor) -> float:
    error = calibration.motion.n - n
    return float(error @ torch.linalg.solve(calibration.motion.covariance, error))


@pytest.mark.parametrize(
    ("quantity", "sigma"), [("left.turn_deg", 0.01), ("right.distortion.0", 1e-3), ("right.view_plane.slope_x", 1e-4)]
)
def test_n_follows_the_rig_as_its_derivative_says(quantity, sigma):
    """Against calibrations of the same corners by a rig that is off by a little."""
    truth, index = Truth.drawn(1), RIG_QUANTITIES.index(quantity)
    rig, known = with_quantities(DATA_SHEET, truth.quantities[0]), torch.zeros(QUANTITIES, QUANTITIES).double()
    known[index, index] = sigma**2
    moved = quantities_of(rig)
    moved[index] += sigma
    found = []
    for each in (rig, with_covariance(rig, known), with_quantities(rig, moved)):
        torch.manual_seed(5)
        found.append(calibrate(measured(truth, each, truth.n[0]), ideal_rig(each), CalibrationConfig()).motion)
    off = found[2].n - found[0].n
    expected = torch.outer(off, off)
    widened = found[1].covariance - found[0].covariance
    assert float((widened - expected).abs().max()) < 0.03 * float(expected.abs().max())


def chains(runs: int, boards: int = 8) -> list[tuple[float, float]]:
    """NEES of n with and without what is not known of the rig, in runs of drawn rigs that boards calibrate."""
    found = []
    for _ in range(runs):
        truth = Truth.drawn(1)
        names = [f"r{i}" for i in range(boards)]
        options = replace(CONFIG, held_out=False)
        rig = calibrate_rig(first_of(truth.scanned(boards)), names, DATA_SHEET, options).rig
        corners = measured(truth, rig, truth.n[0])
        pair = (corners, [replace(board, by_rig=None) for board in corners])
        found.append(tuple(nees(calibrate(each, ideal_rig(rig), CalibrationConfig()), truth.n[0]) for each in pair))
    return found


@pytest.mark.slow
def test_sigmas_of_n_cover_the_errors_of_a_calibrated_rig():
    runs = 40
    by_run = torch.tensor(chains(runs)).mean(0)
    low, high = mean_chi_square_band(3, runs, 0.99)
    assert low < float(by_run[0]) < high
    assert float(by_run[1]) > 1.3 * float(by_run[0])  # without what is not known of the rig: 4.1, with it 2.8
