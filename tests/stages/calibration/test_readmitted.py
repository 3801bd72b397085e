"""Lines of corners that a shake displaces are no corners that were misread."""

import dataclasses

import torch

from lsvision.simulation import BoardPose
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.stages.calibration.outliers import little_off
from lsvision.stages.calibration.readmitted import solve_readmitting
from lsvision.stages.calibration.solved import solve
from lsvision.study.points import Conditions, exact_corners
from lsvision.study.shaken import ScanNoise, Vibration, shaken_scans
from lsvision.types import Board, BoardCorners, Rig

RIG, BOARD = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375), Board(12, 9, 30.0)
POSES = [BoardPose(2.0, 1.5, 0.0), BoardPose(-5.0, 1.0, 6.0), BoardPose(5.0, -2.0, -8.0), BoardPose(-1.0, -3.5, 14.0)]
SEEN_EVERY_MM = 20.0  # edges are not asked for


def shaken_corners() -> list[BoardCorners]:
    """Corners of four boards under long waves, whose ends leave the maps of their boards."""
    chance = torch.Generator().manual_seed(1006)
    exact = exact_corners(RIG, BOARD, {"four": POSES}, Conditions("four", stretch=1.0246))
    torch.rand(3, generator=chance, dtype=torch.float64)
    vibration = Vibration.drawn((0.3, 0.3, 3e-4), (266.0, 190.0, 259.0), len(POSES), chance)
    return shaken_scans(RIG, BOARD, exact, vibration, ScanNoise(line_pitch_mm=SEEN_EVERY_MM), chance).corners


def test_corners_of_lines_that_shook_are_kept():
    measured, config = BoardMeasurements.of(shaken_corners()), CalibrationConfig()
    before = solve(measured, config)
    assert int(before.outlying.sum(-1).amax()) > 9
    assert bool((little_off(measured, before.outlying) == before.outlying).all())
    after = solve_readmitting(measured, config)
    assert not after.outlying.any()
    assert bool(after.along_scan.found)


def test_corners_that_were_misread_are_left_out_of_a_scan_that_shook():
    corners = shaken_corners()
    points = corners[1].points.clone()
    points[5::6, 0] += 2.5 * (-1.0) ** torch.arange(len(points[5::6]), dtype=torch.float64)
    corners[1] = dataclasses.replace(corners[1], points=points)
    found = solve_readmitting(BoardMeasurements.of(corners), CalibrationConfig())
    assert bool(found.outlying[1, 5::6].all())


def test_corners_that_lie_far_off_are_not_tried():
    corners = shaken_corners()
    points = corners[0].points.clone()
    points[:12, 2] += 25.0
    corners[0] = dataclasses.replace(corners[0], points=points)
    measured = BoardMeasurements.of(corners)
    off = torch.zeros(len(corners), len(points), dtype=torch.bool)
    off[0, :12] = True
    assert not little_off(measured, off).any()
    assert bool(solve_readmitting(measured, CalibrationConfig()).outlying[0, :12].all())
