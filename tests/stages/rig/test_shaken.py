"""Boards that shook: the rig comes out as well as its sigmas say, and the motion of the lines is named."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.geometry import RawPair, rotation_from_vector, transform
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import QUANTITIES, Shared
from lsvision.stages.rig.shaken import allow_for_line_motion
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.stages.rig.solve import solve_rig
from lsvision.study.rig_scans import RigConditions, board_poses, from_middle
from lsvision.types import Board
from tests.stages.rig.boards import CONFIG, DATA_SHEET, PRIOR, Truth

BOARD = Board(12, 9, 30.0)
WAVES_MM = (233.0, 97.0, 61.0)
SIGMA = torch.tensor([0.03, 0.03 * 0.07], dtype=torch.float64)


def waves(travel: torch.Tensor, rms: float) -> torch.Tensor:
    """A vibration of each board, of random phases."""
    phase = 2 * math.pi * torch.rand(len(WAVES_MM), len(travel), 1, dtype=torch.float64)
    length = torch.tensor(WAVES_MM, dtype=torch.float64)[:, None, None]
    return rms * math.sqrt(2 / len(WAVES_MM)) * torch.sin(2 * math.pi * travel / length + phase).sum(0)


def shaken_sightings(truth: Truth, boards: int, sideways_mm: float, depth_mm: float, roll_deg: float) -> Sightings:
    """What a rig sees of boards that shake: on its own line, each camera."""
    poses = board_poses(DATA_SHEET, BOARD, RigConditions(boards=boards), 1)
    points = transform(poses.rotation[0], poses.translation[0], from_middle(BOARD).expand(boards, -1, 3))
    pair, n = RawPair.of(DATA_SHEET, truth.quantities[0]), truth.n[0]
    state = torch.random.get_rng_state()
    eyes = []
    for seen in (pair.seen_left, pair.seen_right):
        torch.random.set_rng_state(state)  # the same vibration for both
        travel = seen(points, n).travel
        dx, dz = waves(travel, sideways_mm), waves(travel, depth_mm)
        roll = waves(travel, math.radians(roll_deg))
        still = points - travel[..., None] * n - pair.middle
        zero = torch.zeros_like(roll)
        turned = (rotation_from_vector(torch.stack([zero, roll, zero], -1)) @ still[..., None])[..., 0]
        moved = turned + pair.middle + torch.stack([dx, zero, dz], dim=-1) + travel[..., None] * n
        found = seen(moved, n)
        exact = torch.stack([found.column, found.travel], dim=-1)
        eyes.append(CameraSighting(exact, SIGMA.diag().expand(*exact.shape, 2)))
    noisy = [replace(eye, position=eye.position + SIGMA * torch.randn_like(eye.position)) for eye in eyes]
    return Sightings(noisy[0], noisy[1], torch.ones(points.shape[:-1], dtype=torch.bool), BOARD.corner_points())


def errors(runs: int, boards: int = 8, size=(0.5, 0.5, 0.02)) -> list[dict[str, float]]:
    """What comes of drawn rigs whose boards shake."""
    found = []
    for _ in range(runs):
        truth = Truth.drawn(1)
        sightings = shaken_sightings(truth, boards, *size)
        white = solve_rig(sightings, PRIOR, CONFIG)
        shaken = allow_for_line_motion(white, sightings, CONFIG)
        shape = HeightShape.of(DATA_SHEET, Shared(truth.quantities[0], truth.n[0]), PRIOR.sigma, 52.0)
        row = {}
        for name, solution in (("white", white), ("along", shaken.solution)):
            off = solution.shared.vector - truth.vector[0]
            row |= {
                f"{name}_um": 1e3 * float(shape.bend_mm(off / PRIOR.sigma)),
                f"{name}_stated_um": 1e3 * float(shape.stated_mm(solution.factor)),
                f"{name}_nees": float(off @ torch.linalg.solve(solution.covariance, off)),
                f"{name}_noise": float(solution.noise_scale),
                f"{name}_n1": abs(float(off[QUANTITIES])),
            }
        found.append(row)
    return found


@pytest.mark.slow
def test_shaken_boards_calibrate_a_rig():
    truth = Truth.drawn(1)
    sightings = shaken_sightings(truth, 8, 0.5, 0.5, 0.02)
    found = calibrate_rig(sightings, [f"s{i}" for i in range(8)], DATA_SHEET, CONFIG)
    assert found.noise_scale < 1.3
    assert found.verdict in ("determined", "prior-dominated")
    assert {error.component for error in found.errors_along_scan} >= {"x", "z"}


@pytest.mark.slow
def test_no_corner_is_an_outlier_because_its_line_moved():
    """But those that the search for the motion leaves out, which count as still otherwise, are left out."""
    truth = Truth.drawn(1)
    sightings = shaken_sightings(truth, 8, 0.5, 0.5, 0.02)
    white = solve_rig(sightings, PRIOR, CONFIG)
    shaken = allow_for_line_motion(white, sightings, CONFIG).solution
    assert int(white.outliers.sum()) > 50
    assert int(shaken.outliers.sum()) < int(white.outliers.sum()) / 2
    assert torch.equal(shaken.outliers, sightings.valid.sum(-1) - shaken.sightings.valid.sum(-1))
