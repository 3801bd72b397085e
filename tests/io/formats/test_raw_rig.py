import dataclasses
import math
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.io.formats.raw_rig import raw_rig_from_dict, raw_rig_to_dict, read_raw_rig, write_raw_rig
from lsvision.types import RawCamera, RawRig, ViewPlane

TURN = math.radians(12.53)
RIG = RawRig(
    7142, 10.0, 354.0, RawCamera(113.84, 3570.5, TURN), RawCamera(113.84, 3570.5, -TURN), ViewPlane(0.25, 0.003, 0.002),
    (-4.0, 0.0, 4.0), (("baseline_mm", 0.1), ("left.focal_length_mm", 0.02)),
)  # fmt: skip

positive = st.floats(1e-300, 1e300)
cameras = st.builds(
    RawCamera, positive, st.floats(-1e6, 1e6), st.floats(-1.5, 1.5), st.tuples(*[st.floats(-1.0, 1.0)] * 2)
)


@given(cameras, cameras)
def test_yaml_round_trip(left, right):
    rig = dataclasses.replace(RIG, left=left, right=right)
    back = raw_rig_from_dict(yaml.safe_load(yaml.safe_dump(raw_rig_to_dict(rig))), Path("rig.yaml"))
    turns = [(camera.turn_rad, other.turn_rad) for camera, other in ((left, back.left), (right, back.right))]
    assert all(one == pytest.approx(other, rel=1e-14) for one, other in turns)  # degrees in the file
    assert dataclasses.replace(back, left=left, right=right) == rig


def test_file_is_the_documented_one(tmp_path):
    write_raw_rig(RIG, tmp_path / "rig.yaml")
    assert (tmp_path / "rig.yaml").read_text() == (
        "format: lsvision-rig/2\n"
        "width_px: 7142\n"
        "pixel_pitch_um: 10.0\n"
        "baseline_mm: 354.0\n"
        "left:\n"
        "  focal_length_mm: 113.84\n"
        "  principal_point_px: 3570.5\n"
        "  turn_deg: 12.53\n"
        "  distortion: [0.0, 0.0]\n"
        "right:\n"
        "  focal_length_mm: 113.84\n"
        "  principal_point_px: 3570.5\n"
        "  turn_deg: -12.53\n"
        "  distortion: [0.0, 0.0]\n"
        "  view_plane: {offset_mm: 0.25, slope_x: 0.003, slope_z: 0.002}\n"
        "color_spacing_lines: {red: -4.0, green: 0.0, blue: 4.0}\n"
        "sigma: {baseline_mm: 0.1, left.focal_length_mm: 0.02}\n"
    )
    assert read_raw_rig(tmp_path / "rig.yaml") == RIG


def test_another_makers_file_is_read(shared_data):
    rig = read_raw_rig(shared_data / "scans_shaken_and_raw" / "raw_a" / "rig.yaml")
    assert (rig.width_px, rig.left.principal_px, rig.view_plane) == (893, 446.0, ViewPlane())


def test_the_covariance_comes_back_to_the_bit(tmp_path):
    factor = [[math.sin(3.0 * i + j) if j <= i else 0.0 for j in range(14)] for i in range(14)]
    covariance = tuple(
        tuple(math.fsum(a * b for a, b in zip(row, other, strict=True)) for other in factor) for row in factor
    )
    rig = dataclasses.replace(RIG, covariance=covariance)
    write_raw_rig(rig, tmp_path / "rig.yaml")
    assert read_raw_rig(tmp_path / "rig.yaml") == rig


EYE = [[float(i == j) for j in range(14)] for i in range(14)]


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("covariance",), EYE[:3], "covariance: expected 14 rows of 14 numbers"),
        (("covariance",), [[1.0] * 14, *EYE[1:]], "covariance: expected a symmetric matrix"),
        (("covariance",), [[-1.0, *EYE[0][1:]], *EYE[1:]], "covariance: expected a positive semidefinite matrix"),
        (("left", "turn_deg"), 90.0, "left.turn_deg: expected a finite number > -90 and < 90, got 90"),
        (("right", "focal_length_mm"), 0.0, "right.focal_length_mm: expected a finite number > 0, got 0"),
        (("left", "distortion"), [0.1], r"left.distortion: expected a list of 2, got \[0.1\]"),
        (("left", "distortion"), [0.1, math.inf], r"left.distortion\[1\]: expected a finite number, got inf"),
        (("left", "view_plane"), {}, "left.view_plane: unknown key"),
        (("right", "view_plane"), {"slope_y": 1.0}, "right.view_plane.slope_y: unknown key"),
        (("sigma", "left.turn"), 0.1, "sigma.left.turn: unknown key; the quantities are left.focal_length_mm"),
        (("sigma", "baseline_mm"), -0.1, "sigma.baseline_mm: expected a finite number >= 0, got -0.1"),
        (("format",), "lsvision-rig/3", "format: expected 'lsvision-rig/2', got 'lsvision-rig/3'"),
    ],
)
def test_bad_entries_are_named(where, value, message):
    data = yaml.safe_load(yaml.safe_dump(raw_rig_to_dict(RIG)))
    *path, key = where
    entry = data
    for name in path:
        entry = entry[name]
    entry[key] = value
    with pytest.raises(FileFormatError, match=message):
        raw_rig_from_dict(data, Path("rig.yaml"))
