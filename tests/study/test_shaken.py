"""Simulated scans of boards that vibrate: corners and crossings lie on the board once the motion is taken away."""

import math

import torch

from lsvision.geometry import displace, middle_point, steadied
from lsvision.simulation import BoardPose
from lsvision.study.points import Conditions, ExactCorners, exact_corners
from lsvision.study.shaken import RandomMotion, ScanNoise, Vibration, shaken_scans
from lsvision.types import Board, Rig

RIG, BOARD = Rig(893, 80.0, 113.84, 354.0, 129.8125, 761.9375), Board(12, 9, 30.0)
POSES = [BoardPose(2.0, 1.5, 0.0), BoardPose(-5.0, 1.0, 14.0)]
EXACT = ScanNoise(corner_mm=1e-9, column_px=1e-9, disparity_px=1e-9, line_pitch_mm=2.0)
SIZE, WAVES = (0.3, 0.2, 3e-4), (61.0, 150.0)


def boards() -> ExactCorners:
    """Two tilted boards in a skewed motion."""
    conditions = Conditions("two", angle_x_deg=2.0, angle_z_deg=1.5, stretch=1.0246)
    return exact_corners(RIG, BOARD, {"two": POSES}, conditions)


def test_corners_and_crossings_lie_on_the_board_once_steadied():
    exact, chance = boards(), torch.Generator().manual_seed(1)
    vibration = Vibration.drawn(SIZE, WAVES, len(POSES), chance)
    scans = shaken_scans(RIG, BOARD, exact, vibration, EXACT, chance)
    for index, (corners, edges) in enumerate(zip(scans.corners, scans.edges, strict=True)):
        for points, measured in ((corners.points, exact.points[index]), (edges.points, None)):
            still = points.clone()
            still[:, ::2] = steadied(points[:, ::2], vibration.at(index, points[:, 1]), middle_point(RIG))
            if measured is not None:
                torch.testing.assert_close(still, measured, atol=1e-6, rtol=0)
                continue
            body = (displace(still, exact.n) - exact.translation[index]) @ exact.rotation[index]
            assert float(body[:, 2].abs().max()) < 1e-6
            torch.testing.assert_close(body[:, 0], edges.start[:, 0], atol=1e-6, rtol=0)
            assert bool(((body[:, 1] > edges.start[:, 1]) & (body[:, 1] < edges.stop[:, 1])).all())
            torch.testing.assert_close(still[:, 1], 2.0 * edges.line.double(), atol=1e-5, rtol=0)


def test_a_vibration_has_its_size_and_new_phases_on_each_board():
    vibration = Vibration.drawn(SIZE, WAVES, 2, torch.Generator().manual_seed(2))
    travel = torch.arange(0.0, 61.0 * 150.0, 0.5, dtype=torch.float64)
    first, second = vibration.at(0, travel), vibration.at(1, travel)
    torch.testing.assert_close(first[:, :3].square().mean(0).sqrt(), torch.tensor(SIZE).double(), rtol=1e-3, atol=0)
    assert not first[:, 3].any()
    assert float((first - second)[:, 0].abs().max()) > 0.1


def test_a_random_motion_has_its_size_and_length():
    motion = RandomMotion.drawn(SIZE, 40.0, 200, torch.Generator().manual_seed(4))
    travel = torch.tensor([20.0, 60.0, 60.5, 61.0, 1e4], dtype=torch.float64)
    values = torch.stack([motion.at(board, travel) for board in range(200)])
    assert not values[..., 3].any()
    size = torch.tensor(SIZE).double()
    torch.testing.assert_close(values[..., :3].square().mean((0, 1)).sqrt(), size, rtol=0.1, atol=0)
    alike = (values[:, 0] * values[:, 1])[:, :3].mean(0) / size.square()
    expected = torch.full_like(alike, (1.0 + math.sqrt(3.0)) * math.exp(-math.sqrt(3.0)))
    torch.testing.assert_close(alike, expected, atol=0.2, rtol=0)
    torch.testing.assert_close(values[:, 2], (values[:, 1] + values[:, 3]) / 2.0)


def test_the_same_seed_gives_the_same_bits():
    exact = boards()
    both = []
    for _ in range(2):
        chance = torch.Generator().manual_seed(3)
        both.append(shaken_scans(RIG, BOARD, exact, Vibration.drawn(SIZE, WAVES, 2, chance), ScanNoise(), chance))
    assert torch.equal(both[0].corners[1].points, both[1].corners[1].points)
    assert torch.equal(both[0].edges[1].points, both[1].edges[1].points)
