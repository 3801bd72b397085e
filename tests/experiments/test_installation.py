"""The installation guide through files: rendered boards, the turns that it asks for, boards rendered again."""

import json
import math

import pytest
import torch

from lsvision.stages.installation.guide import camera_turn

TILTS = {"a": (2.0, 1.5), "b": (-5.0, 1.0), "c": (4.0, -3.0)}


def calibrated(command, folder, motion):
    """Summary of a calibration of rendered boards."""
    for name, (pitch, roll) in TILTS.items():
        scene = (f"scene.pitch_deg={pitch}", f"scene.roll_deg={roll}", f"output={folder / name}")
        moved = [f"motion.{key}={value!r}" for key, value in motion.items()]
        assert command("+experiment=simulate", "scale=4", *moved, *scene) == 0
    scans = ",".join(str(folder / name) for name in TILTS)
    assert command("+experiment=calibrate", f"scans=[{scans}]", folder=f"calibrated_{folder.name}") == 0
    return json.loads((folder.parent / f"calibrated_{folder.name}" / "summary.json").read_text())


@pytest.mark.slow
def test_a_rendered_camera_is_aligned_by_its_guide(command, tmp_path):
    motion = {"angle_x_deg": 2.0, "angle_z_deg": -3.0, "stretch": 1.0246}
    before = calibrated(command, tmp_path / "before", motion)["installation"]
    assert before["verdict"] == "outside tolerance"
    asked = before["turn_cameras_deg"]
    turn = camera_turn(*(math.radians(asked[axis]["angle"]) for axis in ("about_x", "about_z")))
    direction = torch.tensor([math.tan(math.radians(2.0)), 1.0, math.tan(math.radians(-3.0))], dtype=torch.float64)
    n1, n2, n3 = (turn.mT @ direction).tolist()
    assert before["line_pitch"]["set"]["line_pitch_mm"] == pytest.approx(0.28 * 1.0246, rel=2e-4)
    ratio = before["line_pitch"]["set"]["encoder_ratio"]
    aligned = {
        "angle_x_deg": math.degrees(math.atan2(n1, n2)),
        "angle_z_deg": math.degrees(math.atan2(n3, n2)),
        "stretch": 1.0246 * ratio,
    }
    after = calibrated(command, tmp_path / "after", aligned)["installation"]
    assert abs(after["turn_cameras_deg"]["about_z"]["angle"]) <= 0.02
    assert abs(after["line_pitch"]["stretch"] - 1) <= 1e-4
    assert after["verdict"] == "within tolerance"


def test_mounting_points_are_options(command, capsys):
    """They take the place of the usual ones; one alone is refused before anything is read."""
    one = "installation.mounting_points={front: [0, 100, 0]}"
    assert command("+experiment=calibrate", "scans=[nowhere]", one) == 1
    expected = "error: installation.mounting_points: expected two points or more, got 1\n"
    assert capsys.readouterr().err == expected
    two = "installation.mounting_points={front: [0, 100, 0], back: [0, -100, 0]}"
    assert command("+experiment=calibrate", "scans=[nowhere]", two, folder="other") == 1
    assert "nowhere" in capsys.readouterr().err
