"""The installation guide: exact turns, honest where the boards say nothing, and right when it is followed."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.errors import ConfigError
from lsvision.geometry import rotation_from_vector, scan_position, transform
from lsvision.io.formats.installation import installation_to_dict
from lsvision.report.installation_words import installation_lines
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.installation.config import InstallationConfig
from lsvision.stages.installation.guide import Transported, camera_turn, installation_guide
from lsvision.types import Board, BoardCorners, Installation, Motion, Rig

PITCH = Transported(0.07)
CONFIG = InstallationConfig()
SIGMA = torch.diag(torch.tensor([1e-5, 1e-5, 1e-4], dtype=torch.float64).square())
N = torch.tensor([0.0357, 1.0236, -0.0268], dtype=torch.float64)


def guide(n=N, covariance=SIGMA, moved=PITCH, config=CONFIG) -> Installation:
    return installation_guide(Motion(n, covariance), 0.05, moved, config)


def after(guided: Installation, n: torch.Tensor) -> torch.Tensor:
    """The motion as the turned cameras see it, at the pitch that was set."""
    turn = camera_turn(*(math.radians(turn.angle_deg) for turn in (guided.about_x, guided.about_z)))
    return turn.mT @ n / guided.pitch.stretch


@pytest.mark.parametrize("n", [N, -N + torch.tensor([0.0, 2.2, 0.0]), torch.tensor([0.0, 0.98, 0.05]).double()])
def test_turned_cameras_see_the_motion_along_y_at_the_stated_pitch(n):
    torch.testing.assert_close(after(guide(n), n), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_signs_by_hand():
    """An object that drifts to larger columns as Y grows: the end at the larger columns goes back, to smaller Y."""
    sideways = guide(torch.tensor([0.05, 1.0, 0.0], dtype=torch.float64))
    assert sideways.about_z.angle_deg == pytest.approx(-math.degrees(math.atan(0.05)))
    shifts = {item.name: item.shift_mm for item in sideways.shifts}
    assert shifts["larger columns"] == pytest.approx((-0.25, -9.99, 0.0), abs=0.005)
    assert any("larger columns moves to where the object goes" in line for line in installation_lines(sideways))
    deeper = guide(torch.tensor([0.0, 1.0, 0.05], dtype=torch.float64))
    assert deeper.about_x.angle_deg == pytest.approx(math.degrees(math.atan(0.05)))
    assert {item.name: item.shift_mm for item in deeper.shifts}["larger Y"][2] == pytest.approx(4.994, abs=0.001)
    assert any("the side where the object comes from moves nearer" in line for line in installation_lines(deeper))
    reverse = guide(torch.tensor([0.0, 1.0, 0.05], dtype=torch.float64), moved=Transported(0.07, "reverse"))
    assert any("the side where the object goes moves nearer" in line for line in installation_lines(reverse))


def test_shifts_are_those_of_a_rigid_body():
    points = {"a": (120.0, 30.0, -40.0), "b": (-80.0, 10.0, 5.0), "c": (0.0, -90.0, 20.0)}
    found = guide(config=InstallationConfig(mounting_points=points))
    before = torch.tensor(list(points.values()), dtype=torch.float64)
    now = before + torch.tensor([item.shift_mm for item in found.shifts], dtype=torch.float64)
    torch.testing.assert_close(torch.cdist(now, now), torch.cdist(before, before))
    torch.testing.assert_close(now.mean(0), before.mean(0))


@pytest.mark.parametrize(
    ("angle", "sigma", "verdict"),
    [(2.9, 1e-4, "within tolerance"), (3.1, 1e-4, "outside tolerance"), (2.9, 3e-3, "not known")],
)
def test_the_verdict_leaves_two_sigmas(angle, sigma, verdict):
    n = torch.tensor([math.tan(math.radians(angle)), 1.0, 0.0], dtype=torch.float64)
    assert guide(n, sigma**2 * torch.eye(3, dtype=torch.float64)).verdict == verdict


def test_no_advice_where_nothing_was_observed():
    """Of one board, n2 and n3 are known in a combination alone."""
    weak = torch.tensor([0.0, 0.3, 0.954], dtype=torch.float64)
    found = guide(covariance=SIGMA + 0.0024 * torch.outer(weak, weak))
    assert (found.about_x.observed, found.about_z.observed, found.pitch.observed) == (False, True, True)
    assert all(abs(item.shift_mm[2]) < 1e-9 for item in found.shifts)
    assert sum("no advice about the sensor axis" in line for line in installation_lines(found)) == 1
    data = installation_to_dict(found)
    assert data["turn_cameras_deg"]["about_x"]["angle"] is None
    wide = guide(covariance=0.0024 * torch.eye(3, dtype=torch.float64))
    assert installation_to_dict(wide)["line_pitch"]["set"] is None
    assert any("do not show the stretch" in line for line in installation_lines(wide))


def test_scans_of_several_pitches_get_a_ratio():
    found = guide(moved=Transported(None))
    assert found.pitch.true_mm is None
    assert any(line.startswith("  line pitch   set 0.97") for line in installation_lines(found))


def test_one_mounting_point_is_refused():
    with pytest.raises(ConfigError, match="mounting_points: expected two points or more, got 1"):
        InstallationConfig(mounting_points={"a": (0.0, 0.0, 0.0)})


def board_corners(n: torch.Tensor, tilt: tuple[float, float], seed: int) -> BoardCorners:
    """A board that moves by n, with the noise of corners at full size."""
    generator, points = torch.Generator().manual_seed(seed), Board(12, 9, 30.0).corner_points()
    turn = rotation_from_vector(torch.deg2rad(torch.tensor([*tilt, 0.0], dtype=torch.float64)))
    middle = torch.tensor([177.0, 200.0, 797.0], dtype=torch.float64)
    seen = scan_position(transform(turn, middle, points - points.mean(0)), n)
    sigma = torch.tensor([0.002, 0.002, 0.006], dtype=torch.float64)
    seen = seen + sigma * torch.randn(seen.shape, dtype=seen.dtype, generator=generator)
    covariance = sigma.square().diag().expand(len(points), 3, 3)
    valid = torch.ones(len(points), dtype=torch.bool)
    return BoardCorners(f"s{seed}", seen, covariance, valid, points, seen[:, :2])


def test_following_the_guide_leaves_nothing_to_align():
    rig = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
    tilts = ((2.0, 1.5), (-5.0, 1.0), (4.0, -3.0), (-2.0, -4.0))

    def calibrated(n, seed):
        boards = [board_corners(n, tilt, seed + i) for i, tilt in enumerate(tilts)]
        found = calibrate(boards, rig, CalibrationConfig())
        return replace(found, installation=guide(found.motion.n, found.motion.covariance))

    first = calibrated(N, 10)
    assert first.installation.verdict == "within tolerance"
    assert first.installation.angle_deg == pytest.approx(2.5, abs=0.05)
    second = calibrated(after(first.installation, N), 20)
    assert abs(second.installation.about_z.angle_deg) < 0.02
    assert abs(second.installation.about_x.angle_deg) < 0.02
    assert abs(second.motion.stretch - 1) < 1e-4
