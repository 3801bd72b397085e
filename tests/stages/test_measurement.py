"""Boards measured in products: distances by hand, in a made product, and after a whole chain on another renderer."""

from pathlib import Path

import pytest
import torch

from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.measurement import BoardMeasurement, distance_errors, measure_board
from lsvision.types import Board, Motion, Scan, TensorImage
from tests.stages.other_renderer import tilt_corners, tilt_scans, true_motion
from tests.stages.rendered import BOARD, depth_scan, simulation

NOMINAL = Motion(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64))


def measured(scan: Scan, motion: Motion, matching: DisparityConfig | None = None) -> BoardMeasurement | None:
    """Correct a whole scan and measure the board in the product."""
    config = CorrectionConfig()
    grid = plan_product(scan, motion, config)
    strips = list(correct_scan(scan, depth_of(scan, matching), motion, config, grid))
    color, height = torch.cat([s.color for s in strips]), torch.cat([s.height for s in strips])
    return measure_board(TensorImage(color), TensorImage(height[..., None]), grid, BOARD)


def test_distances_by_hand():
    board = Board(3, 3, 10.0)  # 2 x 2 inner corners
    points = board.corner_points()
    every = torch.ones(4, dtype=torch.bool)
    assert distance_errors(points, board, every) == pytest.approx((0.0, 0.0), abs=1e-12)
    # Stretched along X by a tenth: two of four sides are 1 mm longer, both diagonals hypot(11, 10) - hypot(10, 10).
    longer = points * torch.tensor([1.1, 1.0, 1.0])
    diagonal = (221**0.5 - 200**0.5) ** 2
    expected = (0.5**0.5, ((2 * 1.0 + 2 * diagonal) / 6) ** 0.5)
    assert distance_errors(longer, board, every) == pytest.approx(expected, rel=1e-6)
    # A corner that was not seen may be anything.
    points[3] = torch.nan
    assert distance_errors(points, board, torch.tensor([True, True, True, False])) == pytest.approx((0, 0), abs=1e-12)


def test_a_pose_changes_no_distance():
    turned = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    points = BOARD.corner_points() @ turned.mT + torch.tensor([300.0, 5e4, 800.0])
    assert distance_errors(points, BOARD, torch.ones(88, dtype=torch.bool)) == pytest.approx((0, 0), abs=1e-9)


def test_a_rendered_board_keeps_its_size():
    source = simulation()
    scan, motion = depth_scan(source), Motion(source.trajectory.n, NOMINAL.covariance)
    corrected, nominal = measured(scan, motion), measured(scan, NOMINAL)
    assert corrected.valid.all()
    assert corrected.neighbour_rms_mm < 0.05
    assert corrected.distance_rms_mm < 0.05
    assert nominal.distance_rms_mm > 1.0


def test_no_board_measures_nothing():
    source = simulation()
    grid = plan_product(depth_scan(source), NOMINAL, CorrectionConfig())
    blank = TensorImage(torch.full((200, 300, 3), 90, dtype=torch.uint8))
    assert measure_board(blank, TensorImage(torch.zeros(200, 300, 1)), grid, BOARD) is None


@pytest.mark.slow
def test_chain_on_another_renderer(shared_data: Path):
    scans = tilt_scans(shared_data)
    calibration = calibrate(tilt_corners(shared_data), scans[0].rig, CalibrationConfig())
    error = (calibration.motion.n - true_motion(scans[0])).abs()
    assert (error <= torch.tensor([5e-5, 5e-5, 4e-4])).all()
    assert calibration.rmse_after_mm <= 0.04
    assert calibration.verdict == "determined"
    scan = scans[1]
    wide = DisparityConfig(height_range_mm=(-60.0, 60.0))
    corrected, nominal = measured(scan, calibration.motion, wide), measured(scan, NOMINAL, wide)
    assert corrected.valid.all()
    assert corrected.distance_rms_mm <= 0.04
    assert nominal.distance_rms_mm > 1.0
