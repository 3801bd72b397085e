"""Scans that are broken in every way seen: each is a row with its reason, the others are done."""

import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import tifffile
import torch
import zarr

from lsvision.archive import LEDGER_FILE, EngineConfig, Ledger, sole_run
from lsvision.errors import ConfigError, ScansFailedError
from lsvision.experiments.reprocess import ReprocessSettings, StatusSettings, run_reprocess, run_status
from lsvision.io import read_product
from tests.archive.archives import PROCESSING, RIG, make_calibration, make_scan

GOOD_NAME = "Schiene 7, Köpfe läuft 東"
REASONS = {
    "truncated": r"left.tif: (cut short|not a readable TIFF)",
    "no right image": r"scan.yaml: right: no such file",
    "wrong width": r"scan.yaml: left: expected 64 columns as the rig has, got 60",
    "unreadable yaml": r"scan.yaml: expected plain YAML",
    "other rig": r"the calibration is for another rig: baseline_mm",
    "no permission": r"(Permission denied|cannot be read)",
    "zero lines": r"left.zarr: expected an image, got 0 lines of 64 px",
    "nan pitch": r"scan.yaml: line_pitch_mm: expected a finite number",
    "python tag": r"scan.yaml: expected plain YAML",
    "loop": r"a symbolic link that loops back to",
    "other depth": r"scan.yaml: depth: expected 40 lines as left has, got 41",
}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture(params=[3, pytest.param(188, marks=pytest.mark.slow)])
def good(request) -> set[str]:
    """Names of the scans that are whole, one of them unusual."""
    return {GOOD_NAME, *(f"good {number}" for number in range(request.param))}


@pytest.fixture
def broken(tmp_path: Path, good: set[str]) -> Iterator[Path]:
    """Eleven broken scans among good ones."""
    root = tmp_path / "archive"
    for name in [*REASONS, *good]:
        if name != "loop":
            rig = dataclasses.replace(RIG, baseline_mm=300.0) if name == "other rig" else RIG
            make_scan(root / name, 40, len(name), stereo=name == "no right image", rig=rig)
    left = root / "truncated" / "left.tif"
    left.write_bytes(left.read_bytes()[:-500])
    (root / "no right image" / "right.tif").unlink()
    tifffile.imwrite(root / "wrong width" / "left.tif", torch.zeros(40, 60, 3, dtype=torch.uint8).numpy())
    (root / "unreadable yaml" / "scan.yaml").write_text("format: [lsvision-scan/1\nrig: }")
    zarr.create_array(root / "zero lines" / "left.zarr", shape=(0, 64, 3), chunks=(1, 64, 3), dtype="uint8")
    edit(root / "zero lines" / "scan.yaml", "left.tif", "left.zarr")
    edit(root / "nan pitch" / "scan.yaml", "line_pitch_mm: 1.12", "line_pitch_mm: .nan")
    edit(root / "python tag" / "scan.yaml", "line_pitch_mm: 1.12", "line_pitch_mm: !!python/object/apply:os.getcwd []")
    (root / "loop").symlink_to(root)
    tifffile.imwrite(root / "other depth" / "depth.tif", torch.zeros(41, 64).numpy())
    (root / "no permission").chmod(0)
    yield root
    (root / "no permission").chmod(0o755)


def settings(archive: Path, output: Path, **options: object) -> ReprocessSettings:
    calibration = make_calibration(output.parent / "calibration.json")
    values = {
        "name": "reprocess",
        "archive": str(archive),
        "calibration": str(calibration),
        "output": str(output),
        "engine": EngineConfig(workers=1),
        "disparity": PROCESSING.disparity,
        "correction": PROCESSING.correction,
        "line_motion": "none",
    }
    return ReprocessSettings(**(values | options))


def as_somebody(monkeypatch: pytest.MonkeyPatch, closed: Path) -> None:
    """Root reads everything: let the folder refuse as it does to anybody else."""
    if os.geteuid() == 0:
        look = os.scandir

        def refused(folder):
            if not isinstance(folder, int) and Path(folder) == closed:
                raise PermissionError(13, "Permission denied", str(folder))
            return look(folder)

        monkeypatch.setattr(os, "scandir", refused)


def test_eleven_are_told_with_their_reason_and_the_others_done(broken, good, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    as_somebody(monkeypatch, broken / "no permission")
    with pytest.raises(ScansFailedError, match=f"11 of {11 + len(good)} scans failed") as failure:
        run_reprocess(settings(broken, tmp_path / "o"), tmp_path / "run")
    assert failure.value.exit_code == 11
    with Ledger(tmp_path / "o" / LEDGER_FILE) as ledger:
        rows = ledger.scans()
    assert {key for key, row in rows.items() if row.status == "done"} == good
    for name, reason in REASONS.items():
        assert rows[name].status == "failed"
        assert re.search(reason, rows[name].error), (name, rows[name].error)
    assert (tmp_path / "o" / f"{GOOD_NAME}.zarr" / "zarr.json").is_file()
    page = (tmp_path / "run" / "report.html").read_text()
    assert GOOD_NAME in page
    assert "another rig" in page
    caplog.clear()
    run_status(StatusSettings(name="status", output=str(tmp_path / "o")), tmp_path)
    assert sum("failed" in line for line in caplog.messages) == 11


def test_a_dry_run_tells_and_writes_nothing(archive, tmp_path, caplog):
    caplog.set_level("INFO")
    run_reprocess(settings(archive, tmp_path / "o", dry_run=True), tmp_path / "run")
    assert "4 scans to do with 376 lines, 0 unchanged, 0 that cannot be read" in caplog.text
    assert "on 1 workers, at most 0.00 GB" in caplog.text
    assert not (tmp_path / "o").exists()


def test_a_second_run_on_an_output_says_so_and_stops(archive, tmp_path):
    with (
        sole_run(tmp_path / "o"),
        pytest.raises(ConfigError, match="output: another run is working on"),
    ):
        run_reprocess(settings(archive, tmp_path / "o"), tmp_path / "run")
    with sole_run(tmp_path / "o"):
        pass


def test_an_archive_without_scans(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="archive: no scans in"):
        run_reprocess(settings(tmp_path / "empty", tmp_path / "o"), tmp_path / "run")


def test_the_ledger_of_what_is_no_output(tmp_path):
    with pytest.raises(ConfigError, match="output: no ledger in"):
        run_status(StatusSettings(name="status", output=str(tmp_path)), tmp_path)


def test_a_damaged_product_is_found_and_made_anew(archive, tmp_path):
    run_reprocess(settings(archive, tmp_path / "o", verify=True), tmp_path / "run")
    whole = read_product(tmp_path / "o" / "a.zarr").height(0, 64).numpy().tobytes()
    chunk = tmp_path / "o" / "a.zarr" / "height" / "0" / "c" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"?")
    run_reprocess(settings(archive, tmp_path / "o"), tmp_path / "run")
    with pytest.raises(Exception, match="checksum"):
        read_product(tmp_path / "o" / "a.zarr").height(0, 64)
    run_reprocess(settings(archive, tmp_path / "o", verify=True), tmp_path / "run")
    assert read_product(tmp_path / "o" / "a.zarr").height(0, 64).numpy().tobytes() == whole
