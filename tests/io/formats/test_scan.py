import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import tifffile
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lsvision.errors import FileFormatError
from lsvision.geometry import ideal_rig, zero_disparity_mm
from lsvision.io import read_scan, write_line_image, write_rig
from lsvision.io.formats.raw_rig import write_raw_rig
from lsvision.types import DepthView, RawCamera, RawRig, Rig, Travel, ViewPlane

MakeScan = Callable[..., Path]


def edit(folder: Path, **changes: object) -> None:
    """Change entries of a scan.yaml; None removes one."""
    data = yaml.safe_load((folder / "scan.yaml").read_text()) | changes
    (folder / "scan.yaml").write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))


def test_round_trip(make_scan: MakeScan, small_rig: Rig, images) -> None:
    scan = read_scan(make_scan())
    assert scan.rig == small_rig
    assert scan.travel == Travel(0.56)
    assert scan.lines == 300
    assert torch.equal(scan.left.read(0, 300), images[0])
    assert torch.equal(scan.images.right.read(0, 300), images[1])
    assert (scan.color_registered, scan.attributes) == (True, {})


def test_everything_optional(make_scan: MakeScan, small_rig: Rig) -> None:
    positions = torch.rand(300, dtype=torch.float64).cumsum(0)
    depth = zero_disparity_mm(small_rig) + torch.randn(300, 32, 1)
    depth = depth.masked_fill(torch.rand(300, 32, 1) < 0.1, torch.nan)
    folder = make_scan(
        travel=Travel(0.56, positions, "reverse"),
        right=None,
        depth=[depth],
        attributes={"rail": "A-1234", "heat": "0042", "Schicht": "früh"},
        color_registered=False,
        extra_json={"truth.json": {"n": [0.0, 1.0, 0.0]}},
    )
    scan = read_scan(folder)
    assert torch.equal(scan.travel.positions_mm, positions)
    assert scan.travel.transport == "reverse"
    assert isinstance(scan.images, DepthView)
    torch.testing.assert_close(scan.images.depth.read(0, 300), depth, rtol=0, atol=0, equal_nan=True)
    assert scan.attributes == {"rail": "A-1234", "heat": "0042", "Schicht": "früh"}
    assert not scan.color_registered
    assert (folder / "truth.json").is_file()


@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pitch=st.floats(1e-9, 1e9), attributes=st.dictionaries(st.text(), st.text(), max_size=3), flag=st.booleans())
def test_any_values_round_trip(make_scan: MakeScan, pitch: float, attributes: dict, flag: bool) -> None:
    scan = read_scan(make_scan(travel=Travel(pitch), attributes=attributes, color_registered=flag))
    assert (scan.travel.line_pitch_mm, scan.attributes, scan.color_registered) == (pitch, attributes, flag)


def test_folder_and_file_are_the_same_scan(make_scan: MakeScan, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_scan()
    monkeypatch.chdir(folder.parent)
    assert read_scan("scan").path == read_scan("scan/scan.yaml").path == Path("scan")


def test_rig_may_lie_outside_the_folder(make_scan: MakeScan, small_rig: Rig) -> None:
    folder = make_scan()
    (folder / "rig.yaml").rename(folder.parent / "rig.yaml")
    edit(folder, rig="../rig.yaml", attributes={"shift": 2, "speed": 1.5})
    scan = read_scan(folder)
    assert scan.rig == small_rig
    assert scan.attributes == {"shift": "2", "speed": "1.5"}


def test_encoder_is_repaired_only_if_asked(make_scan: MakeScan) -> None:
    positions = torch.arange(300, dtype=torch.float64)
    positions[7] = -1.0
    folder = make_scan(travel=Travel(0.56, positions))
    with pytest.raises(FileFormatError, match=r"encoder.csv: line 7 not beyond the line before"):
        read_scan(folder)
    assert read_scan(folder, repair_encoder=True).travel.positions_mm[7] == 7.0


def depth_map(rig: Rig) -> torch.Tensor:
    return zero_disparity_mm(rig) + torch.rand(300, 32, 1)


@pytest.mark.parametrize("code", [0.0, -9999.0, math.inf, -math.inf, 1e6])
def test_depth_that_the_rig_cannot_see_was_not_measured(make_scan: MakeScan, small_rig: Rig, code: float) -> None:
    depth = depth_map(small_rig)
    depth[:, 5:] = code  # most of the map
    read = read_scan(make_scan(right=None, depth=[depth])).images.depth.read(10, 20)
    assert torch.equal(read[:, :5], depth[10:20, :5])
    assert read[:, 5:].isnan().all()


def test_a_scan_of_which_nothing_was_measured_can_be_read(make_scan: MakeScan) -> None:
    for code in (math.nan, 0.0, -1.0):
        scan = read_scan(make_scan(right=None, depth=[torch.full((300, 32, 1), code)]))
        assert scan.images.depth.read(0, 300).isnan().all()


@pytest.mark.parametrize(
    ("factor", "offset", "message"),
    [
        (1e-3, 0.0, "median 22.1 where the rig sees 22143 mm: expected depth in mm, these look like metres"),
        (0.1, 0.0, "these look like centimetres"),
        (1e3, 0.0, "these look like micrometres"),
        (1.0, -22143.0, "these look like heights"),
        (1.0, -22140.0, "these look like heights"),
        (1.0, -22000.0, "these look like heights"),
        (300.0, 0.0, "these are no depths of this rig"),
    ],
)
@pytest.mark.parametrize("code", [math.nan, 0.0, -9999.0])
def test_depth_in_another_unit_is_refused(
    make_scan: MakeScan, small_rig: Rig, factor: float, offset: float, message: str, code: float
) -> None:
    depth = factor * (depth_map(small_rig) + offset)
    depth[torch.rand(depth.shape) < 0.3] = code
    folder = make_scan(right=None, depth=[depth])
    with pytest.raises(FileFormatError, match=rf"scan\.yaml: depth: median .*{message.split('median ')[-1]}"):
        read_scan(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"line_pitch_mm": math.nan}, "scan.yaml: line_pitch_mm: expected a finite number > 0, got nan"),
        ({"line_pitch_mm": -0.07}, "line_pitch_mm: expected a finite number > 0, got -0.07"),
        ({"line_pitch_mm": None}, "line_pitch_mm: missing"),
        ({"format": "lsvision-scan/9"}, "format: expected 'lsvision-scan/1', got 'lsvision-scan/9'"),
        ({"encodr": "encoder.csv"}, "encodr: unknown key; did you mean 'encoder'"),
        ({"transport": "backward"}, "transport: expected 'forward' or 'reverse', got 'backward'"),
        ({"left": None}, "left: missing"),
        ({"left": "gone.tif"}, "left: no such file or folder: .*gone.tif"),
        ({"rig": 5}, "rig: expected text, got 5"),
        ({"encoder": "gone.csv"}, "encoder: no such file or folder"),
        ({"right": None}, "right: expected exactly one of right and depth, got 0"),
        ({"depth": "left.tif"}, "right: expected exactly one of right and depth, got 2"),
        ({"right": None, "depth": "left.tif"}, "depth: expected one float32 channel, got 3 of torch.uint8"),
        ({"left": "scan.yaml"}, "scan.yaml: expected a TIFF"),
        ({"color_registered": "yes"}, "color_registered: expected true or false, got 'yes'"),
        ({"attributes": ["a"]}, "attributes: expected keys with values"),
        ({"attributes": {"rail": [1]}}, r"attributes.rail: expected text or a finite number, got \[1\]"),
    ],
)
def test_bad_entries_are_named(make_scan: MakeScan, changes: dict, message: str) -> None:
    folder = make_scan()
    edit(folder, **changes)
    with pytest.raises(FileFormatError, match=message) as raised:
        read_scan(folder)
    assert raised.value.path.parent == folder


def test_python_tags_are_never_executed(make_scan: MakeScan) -> None:
    folder = make_scan()
    with (folder / "scan.yaml").open("a") as file:
        file.write(f"attributes: !!python/object/apply:os.mkdir [{folder / 'harm'}]\n")
    with pytest.raises(FileFormatError, match=r"scan\.yaml: expected plain YAML"):
        read_scan(folder)
    assert not (folder / "harm").exists()


def test_no_scan(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"scan\.yaml: no such file"):
        read_scan(tmp_path / "nowhere")


def test_images_must_fit_each_other_and_the_rig(make_scan: MakeScan, small_rig: Rig) -> None:
    folder = make_scan()
    write_line_image(folder / "right.tif", [torch.zeros(299, 32, 3, dtype=torch.uint8)], (299, 32, 3), torch.uint8)
    with pytest.raises(FileFormatError, match="right: expected 300 lines as left has, got 299"):
        read_scan(folder)
    write_rig(Rig(33, 80.0, 113.84, 354.0, 4.5, 27.25), folder / "rig.yaml")
    with pytest.raises(FileFormatError, match="left: expected 33 columns as the rig has, got 32"):
        read_scan(folder)
    write_rig(small_rig, folder / "rig.yaml")
    tifffile.imwrite(folder / "left.tif", torch.zeros(300, 32).numpy())
    with pytest.raises(FileFormatError, match="left: expected uint8 or uint16"):
        read_scan(folder)


def test_failed_writing_leaves_nothing(make_scan: MakeScan, tmp_path: Path, images) -> None:
    for changes in ({"right": [images[1][:299]]}, {"extra_json": {"truth.json": {"n": math.nan}}}):
        with pytest.raises(ValueError):
            make_scan(**changes)
    assert not any(tmp_path.iterdir())


def test_writing_over_a_scan_replaces_it_and_over_anything_else_does_not(make_scan: MakeScan, tmp_path: Path) -> None:
    make_scan(extra_json={"truth.json": {}})
    assert not (make_scan() / "truth.json").exists()
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").touch()
    with pytest.raises(FileFormatError, match=r"scan\.yaml to replace"):
        make_scan("thesis")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"right": None}, "right, depth: expected exactly one"),
        ({"travel": Travel(0.56, torch.arange(5.0))}, "expected 300 positions, got 5"),
    ],
)
def test_bad_arguments(make_scan: MakeScan, changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_scan(**changes)


def test_scan_of_another_renderer(shared_data: Path) -> None:
    folder = shared_data / "scans_other_renderer" / "tilt_a"
    scan = read_scan(folder)
    assert (scan.lines, scan.rig.width_px, scan.travel.line_pitch_mm) == (704, 893, 0.56)
    for name, image in (("left", scan.left), ("right", scan.images.right)):
        expected = tifffile.imread(folder / f"{name}.tif")
        assert torch.equal(image.read(100, 333), torch.from_numpy(expected[100:333]))


RAW = RawRig(
    32, 80.0, 354.0, RawCamera(113.84, 15.0, 0.2212, (0.01, 0.0)), RawCamera(113.84, 16.0, -0.2203),
    ViewPlane(0.25, 0.003, 0.002), sigma=(("baseline_mm", 0.1),),
)  # fmt: skip


def test_a_scan_of_a_raw_rig(make_scan: MakeScan, small_rig: Rig, tmp_path: Path) -> None:
    folder = make_scan(rig=ideal_rig(RAW), raw_rig=RAW)
    scan = read_scan(folder)
    assert scan.raw_rig is not None
    assert scan.raw_rig.view_plane == RAW.view_plane
    assert scan.raw_rig.left.turn_rad == pytest.approx(0.2212, rel=1e-14)  # degrees in the file
    assert scan.rig == ideal_rig(RAW)
    assert scan.rig.width_px > scan.left.shape[1] == 32
    write_raw_rig(dataclasses.replace(RAW, width_px=33), folder / "rig.yaml")
    with pytest.raises(FileFormatError, match="left: expected 33 columns as the rig has, got 32"):
        read_scan(folder)
    write_raw_rig(dataclasses.replace(RAW, left=RawCamera(113.84, 15.0, -0.3)), folder / "rig.yaml")
    with pytest.raises(FileFormatError, match=r"rig.yaml: the middles of both sensors look at no common point"):
        read_scan(folder)
    (folder / "rig.yaml").write_text("format: lsvision-rig/3")
    with pytest.raises(FileFormatError, match="format: expected lsvision-rig/1 or lsvision-rig/2, got 'lsvision-rig/3"):
        read_scan(folder)
    mapped = make_scan(right=None, depth=[depth_map(small_rig)])
    write_raw_rig(RAW, mapped / "rig.yaml")
    with pytest.raises(FileFormatError, match="rig: expected the rectified rig that the depth was computed with"):
        read_scan(mapped)
