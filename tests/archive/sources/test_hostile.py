"""Archives whose names would lead elsewhere, or two scans to one product."""

import os
import unicodedata
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from lsvision.archive import find_scans, local_archive, plan_one, read_calibrations
from lsvision.archive.plan import plan_run
from lsvision.archive.product import product_path
from lsvision.errors import ConfigError, FileFormatError
from lsvision.experiments.command_line import in_one_line
from lsvision.io import scan_sha256
from lsvision.io.inside import path_inside
from tests.archive.archives import PROCESSING, make_scan, process, touch


def everything_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


@pytest.fixture
def zipped(archive, tmp_path):
    """Pack a good scan, and other entries, into a ZIP; its URL."""

    def make(**entries: str) -> str:
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
            for path in sorted((archive / "a").iterdir()):
                file.write(path, f"x/a/{path.name}")
            for name, text in entries.items():
                file.writestr(name, text)
        return f"zip://::{tmp_path / 'a.zip'}"

    return make


@pytest.mark.parametrize(
    "name", ["../../../evil/scan.yaml", "x/../../../evil/scan.yaml", "x/a/../../../../evil.txt", "x/a/../b/left.tif"]
)
def test_an_entry_of_a_zip_that_leads_outside(zipped, tmp_path, name):
    url = zipped(**{name: "evil"})
    before = everything_below(tmp_path)
    with pytest.raises(ConfigError, match=r"archive: zip://.*: .*\.\..* leads outside the archive"):
        local_archive(url, tmp_path / "out" / "copies")
    assert everything_below(tmp_path) == before


@pytest.mark.parametrize("rig", ["../../../rig.yaml", "../../../../../../../etc/passwd", "{outside}"])
def test_a_rig_of_a_zip_that_leads_outside(zipped, tmp_path, rig):
    outside = tmp_path / "out" / "rig.yaml"
    outside.parent.mkdir()
    outside.write_text("secret")
    scan = f"format: lsvision-scan/1\nrig: {rig.format(outside=outside)}\nline_pitch_mm: 1.0\nleft: left.tif\n"
    url = zipped(**{"x/b/scan.yaml": scan, "x/rig.yaml": "", "rig.yaml": "evil"})
    copies = tmp_path / "out" / "copies"
    found = find_scans(local_archive(url, copies))
    assert [(item.key, item.problem) for item in found if item.problem] == [
        ("b", "scan.yaml: rig: leads outside the archive")
    ]
    assert outside.read_text() == "secret"
    assert everything_below(tmp_path / "out") - everything_below(copies) >= {"rig.yaml", "copies"}


def test_a_rig_above_the_scans_of_a_zip_is_copied_with_them(zipped, tmp_path):
    url = zipped(**{"x/c/y/scan.yaml": "rig: ../../rig.yaml", "x/rig.yaml": "r", "z/scan.yaml": ""})
    local_archive(url, tmp_path / "copies")
    assert (tmp_path / "copies" / "x" / "rig.yaml").read_text() == "r"


def test_copies_are_not_written_through_links(zipped, tmp_path):
    url = zipped()
    (tmp_path / "copies").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "copies" / "a").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="leads outside"):
        local_archive(url, tmp_path / "copies")
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04" + 50 * b"\xff"])
def test_a_damaged_zip_is_one_line(tmp_path, content):
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(ConfigError, match=r"archive: .* cannot be read") as raised:
        local_archive(f"zip://::{tmp_path / 'a.zip'}", tmp_path / "copies")
    assert len(str(raised.value).splitlines()) == 1


def test_a_list_that_goes_up_names_scans_as_they_are(tmp_path):
    touch(tmp_path, "a/s0", "b/s0", "lists/c")
    (tmp_path / "lists" / "list.txt").write_text("../a/s0\nc\n../b/../b/s0\n")
    found = find_scans(str(tmp_path / "lists" / "list.txt"))
    assert [item.key for item in found] == ["a/s0", "b/s0", "lists/c"]
    assert not any(item.problem for item in found)


@pytest.mark.parametrize("key", ["../a", "a/../../b", "/a", "link/a", "loop/a", "nul\0"])
def test_products_lie_below_the_output(tmp_path, key):
    output = tmp_path / "out"
    output.mkdir()
    (output / "link").symlink_to(tmp_path)
    (output / "loop").symlink_to(output / "loop")
    with pytest.raises(FileFormatError, match="leads outside"):
        product_path(output, key)
    assert product_path(output, "a..b/c") == output / "a..b" / "c.zarr"
    assert path_inside(output, "a/../b") == output / "a/../b"


def test_a_product_is_not_written_through_a_link(tmp_path, calibration):
    make_scan(tmp_path / "archive" / "a", 40)
    make_scan(tmp_path / "archive" / "b", 40)
    for name in ("out", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "out" / "a.zarr").symlink_to(tmp_path / "elsewhere")
    rows, _ = process(tmp_path / "archive", calibration, tmp_path / "out")
    assert [(row.scan, row.status) for row in rows] == [("b", "done")]
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(
    "names",
    [("s0", "S0"), ("Straße", "STRASSE"), tuple(unicodedata.normalize(form, "Wärme") for form in ("NFC", "NFD"))],
)
def test_names_that_are_one_on_another_file_system_fail_both(tmp_path, calibration, names):
    touch(tmp_path, *(f"{name}/a" for name in names), "other")
    found = find_scans(str(tmp_path))
    assert [item.problem is None for item in found] == [item.key == "other" for item in found]
    plan = plan_run(found, read_calibrations(calibration), PROCESSING, {}, tmp_path / "out")
    assert sum("differs in nothing but case or Unicode form" in problem for problem in plan.faulty.values()) == 2


def test_a_product_never_lies_within_another_or_the_work(tmp_path):
    touch(tmp_path, "a", "a.zarr/b", ".work/c")
    (tmp_path / "list.txt").write_text("a\na.zarr/b\n.work/c\n")
    problems = {item.key: item.problem for item in find_scans(str(tmp_path / "list.txt"))}
    assert problems.pop("a") is None
    assert all("lies in a folder" in problem for problem in problems.values())


def test_lists_of_other_editors(tmp_path):
    touch(tmp_path, "Wärme")
    (tmp_path / "list.txt").write_bytes("\ufeffWärme\r\n".encode())
    assert [item.key for item in find_scans(str(tmp_path / "list.txt"))] == ["Wärme"]
    for content in ("Wärme".encode("latin-1"), b"a\0b"):
        (tmp_path / "list.txt").write_bytes(content)
        with pytest.raises(ConfigError, match=r"archive: .*list.txt: expected a list"):
            find_scans(str(tmp_path / "list.txt"))


def test_a_name_that_is_not_text_is_a_fault_of_its_scan(tmp_path):
    touch(tmp_path, "a")
    os.mkdir(os.fsencode(tmp_path) + b"/b\xff")
    (Path(os.fsdecode(os.fsencode(tmp_path) + b"/b\xff")) / "scan.yaml").write_text("")
    problems = {item.key: item.problem for item in find_scans(str(tmp_path))}
    assert problems["a"] is None
    (other,) = (key for key in problems if key != "a")
    other.encode()
    assert "not UTF-8" in str(problems[other])


def test_one_hostile_scan_does_not_stop_the_others(tmp_path, calibration):
    make_scan(tmp_path / "good", 40)
    for number, text in enumerate(
        ("attributes: {date: 2024-13-45}", "[" * 5000, "a: &a [1]\nb: *a", "a: " + "9" * 5000, "rig: /dev/zero",
         "rig: /", "left: /", "? [a]\n: b", "a: 1\na: 2")
    ):  # fmt: skip
        make_scan(tmp_path / f"s{number}", 40)
        (tmp_path / f"s{number}" / "scan.yaml").write_text(text)
    plan = plan_run(find_scans(str(tmp_path)), read_calibrations(calibration), PROCESSING, {}, tmp_path / "out")
    assert [scan.key for scan in plan.to_do] == ["good"]
    assert all(len(problem.splitlines()) == 1 for problem in plan.faulty.values())


def test_devices_are_not_hashed(tmp_path):
    scan = make_scan(tmp_path / "a", 40)
    os.mkfifo(tmp_path / "pipe")
    text = (scan / "scan.yaml").read_text()
    (scan / "scan.yaml").write_text(text.replace("left.tif", "../pipe"))
    with pytest.raises(FileFormatError, match="pipe: no such file"):
        scan_sha256(scan)


def test_a_name_with_control_characters_is_a_fault_of_its_scan(tmp_path, calibration):
    make_scan(tmp_path / "line\nbreak\x1b[31m", 40)
    touch(tmp_path, "a", "dollar $HOME ${x} ", "Käfer")
    found = find_scans(str(tmp_path))
    assert [(item.key, item.problem) for item in found if item.problem] == [
        (r"line\nbreak\x1b[31m", "its name has control characters; rename it")
    ]
    with pytest.raises(FileFormatError, match="its name has control characters") as raised:
        plan_one(tmp_path / "line\nbreak\x1b[31m", calibration, PROCESSING)
    assert in_one_line(raised.value).isprintable()


def test_a_zip_that_no_disk_holds(zipped, tmp_path, monkeypatch):
    url = zipped(**{"x/a/extra.bin": "0" * 10_000_000})
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=5_000_000))
    with pytest.raises(ConfigError, match=r"archive: its copies take 0.0 GB, .* has room for 0.0 GB"):
        local_archive(url, tmp_path / "copies")
    assert not (tmp_path / "copies").exists()


def test_a_name_that_no_file_can_have_is_one_line(tmp_path, calibration):
    scan = make_scan(tmp_path / "a", 40)
    (scan / "scan.yaml").write_text((scan / "scan.yaml").read_text().replace("left.tif", '"left\\0.tif"'))
    with pytest.raises(FileFormatError, match="left: no such file or folder"):
        plan_one(scan, calibration, PROCESSING)
