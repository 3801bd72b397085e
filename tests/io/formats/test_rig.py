import math
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.io import read_rig, rig_from_dict, rig_to_dict, write_rig
from lsvision.types import Rig

positive = st.floats(1e-300, 1e300)
offset = st.floats(-1e6, 1e6)


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    left, right = sorted(draw(st.lists(offset, min_size=2, max_size=2, unique=True)))
    spacing = tuple(draw(st.lists(offset, min_size=3, max_size=3)))
    return Rig(draw(st.integers(1, 10**6)), draw(positive), draw(positive), draw(positive), left, right, spacing)


@given(rigs())
def test_yaml_round_trip_is_exact(rig: Rig) -> None:
    assert rig_from_dict(yaml.safe_load(yaml.safe_dump(rig_to_dict(rig))), Path("rig.yaml")) == rig


def test_file_is_the_documented_one(tmp_path: Path) -> None:
    rig = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
    write_rig(rig, tmp_path / "rig.yaml")
    assert (tmp_path / "rig.yaml").read_text() == (
        "format: lsvision-rig/1\n"
        "width_px: 7142\n"
        "pixel_pitch_um: 10.0\n"
        "focal_length_mm: 113.84\n"
        "baseline_mm: 354.0\n"
        "principal_point_px: {left: 1042.0, right: 6099.0}\n"
    )
    assert read_rig(tmp_path / "rig.yaml") == rig


def test_whole_numbers_are_numbers(rig: Rig) -> None:
    data = rig_to_dict(rig) | {"baseline_mm": 354}
    assert asdict(rig_from_dict(data, Path("rig.yaml"))) == asdict(rig)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_length_mm": math.nan}, "rig.yaml: focal_length_mm: expected a finite number > 0, got nan"),
        ({"focal_length_mm": math.inf}, "focal_length_mm: expected a finite number > 0, got inf"),
        ({"baseline_mm": 0}, "baseline_mm: expected a finite number > 0, got 0"),
        ({"baseline_mm": True}, "baseline_mm: expected a finite number > 0, got True"),
        ({"pixel_pitch_um": "ten"}, "pixel_pitch_um: expected a finite number > 0, got 'ten'"),
        ({"pixel_pitch_um": 10**400}, "pixel_pitch_um: expected a finite number"),
        ({"width_px": 7142.5}, "width_px: expected a whole number >= 1, got 7142.5"),
        ({"width_px": 0}, "width_px: expected a whole number >= 1, got 0"),
        ({"format": "lsvision-rig/2"}, "format: expected 'lsvision-rig/1', got 'lsvision-rig/2'"),
        ({"base_line_mm": 1.0}, "base_line_mm: unknown key; did you mean 'baseline_mm'"),
        ({"principal_point_px": {"left": 9.0, "right": 9.0}}, "principal_point_px.right: .* > 9, got 9.0"),
        ({"principal_point_px": {"left": 1.0}}, "principal_point_px.right: missing"),
        ({"principal_point_px": 7}, "principal_point_px: expected keys with values, got 7"),
        ({"principal_point_px": {"left": 1.0, "right": 2.0, "top": 3}}, "principal_point_px.top: unknown key"),
        ({"color_spacing_lines": {"red": 1.0, "green": 0.0}}, "color_spacing_lines.blue: missing"),
    ],
)
def test_bad_entries_are_named(rig: Rig, change: dict, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        rig_from_dict(rig_to_dict(rig) | change, Path("rig.yaml"))


def test_missing_key_points_to_its_misspelling(rig: Rig) -> None:
    data = rig_to_dict(rig)
    data["focal_lenght_mm"] = data.pop("focal_length_mm")
    with pytest.raises(FileFormatError, match=r"focal_length_mm: missing .*'focal_lenght_mm'"):
        rig_from_dict(data, Path("rig.yaml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("", "expected keys with values, got null"),
        ("- 1\n", "expected keys with values"),
        ("a: [1", "expected plain YAML"),
        ("!!python/object/apply:os.getcwd []", "expected plain YAML.*python"),
        (b"\xff\xfe\x00\x01", "cannot be read as text"),
    ],
)
def test_unreadable_files_are_named(tmp_path: Path, text: str | bytes | None, message: str) -> None:
    file = tmp_path / "rig.yaml"
    if text is not None:
        file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(FileFormatError, match=message) as raised:
        read_rig(file)
    assert raised.value.path == file
    assert "\n" not in str(raised.value)
