"""Simulated scans of boards that vibrate before raw rigs: each camera sees the object as it was on its own line."""

from dataclasses import replace

import torch

from lsvision.geometry import RawPair, shaken, transform
from lsvision.stages.rig.model import Shared
from lsvision.stages.rig.sightings import Sightings
from lsvision.study.rig_scans import RigConditions, board_poses, from_middle, scanned
from lsvision.study.shaken import Vibration
from lsvision.study.shaken_rigs import ShakenBoards
from lsvision.types import Pose
from tests.stages.rig.boards import BOARD, DATA_SHEET, Truth

EXACT = RigConditions(boards=4, column_sigma_px=1e-9, line_sigma=1e-9)


def boards(rms: float) -> ShakenBoards:
    """Four of them, whose vibration has an rms of so many mm, and mrad."""
    truth, chance = Truth.drawn(1), torch.Generator().manual_seed(1)
    vibration = Vibration.drawn((rms, rms, 1e-3 * rms), (61.0, 150.0), 4, chance)
    return ShakenBoards.placed(DATA_SHEET, Shared(truth.quantities[0], truth.n[0]), BOARD, EXACT, vibration)


def test_still_boards_are_seen_as_in_the_study_of_rigs():
    still = boards(0.0)
    truth = Shared(still.truth.quantities.expand(1, 1, -1), still.truth.n.expand(1, 1, -1))
    poses = Pose(still.poses.rotation[None], still.poses.translation[None])
    expected, found = scanned(DATA_SHEET, truth, poses, BOARD, EXACT), still.sightings(EXACT)
    torch.testing.assert_close(found.left.position, expected.left.position[0], atol=1e-7, rtol=0)
    torch.testing.assert_close(found.right.position, expected.right.position[0], atol=1e-7, rtol=0)


def test_a_corner_is_displaced_by_what_moved_on_the_line_of_each_camera():
    """Its ray passes through the displaced point, which lies in the camera's plane on that line."""
    shaking = boards(0.3)
    found, n = shaking.sightings(EXACT), shaking.truth.n
    pair = RawPair.of(DATA_SHEET, shaking.truth.quantities)
    still = transform(shaking.poses.rotation, shaking.poses.translation, from_middle(BOARD).expand(4, -1, 3))
    for left, seen in ((True, found.left), (False, found.right)):
        column, travel = seen.position.unbind(-1)
        motion = torch.stack([shaking.motion.at(board, lines) for board, lines in enumerate(travel)])
        there = still - travel[..., None] * n
        x, z = shaken(there[..., ::2], motion, pair.middle).unbind(-1)
        plane = torch.zeros_like(x) if left else pair.right_plane(x, z)
        slope = pair.left.slope(column) if left else pair.right.slope(column)
        torch.testing.assert_close(there[..., 1], plane, atol=1e-6, rtol=0)
        torch.testing.assert_close(slope * z, x if left else x - pair.baseline_mm, atol=1e-6, rtol=0)


def test_the_same_seed_gives_the_same_bits_and_noise_has_its_size():
    noisy = replace(EXACT, column_sigma_px=0.5, line_sigma=2.0)
    still, both = boards(0.1), []
    for _ in range(2):
        torch.manual_seed(5)
        both.append(still.sightings(noisy))
    assert torch.equal(both[0].left.position, both[1].left.position)
    off = both[0].left.position - still.sightings(EXACT).left.position
    sigma = torch.tensor([0.5, 2.0 * noisy.line_pitch_mm], dtype=torch.float64)
    torch.testing.assert_close(off.flatten(0, 1).std(0), sigma, atol=0, rtol=0.2)
    assert isinstance(both[0], Sightings)


def test_poses_are_those_of_the_study():
    torch.manual_seed(7)
    still = boards(0.0)
    torch.manual_seed(7)
    Truth.drawn(1)
    torch.testing.assert_close(still.poses.translation, board_poses(DATA_SHEET, BOARD, EXACT, 1).translation[0])
