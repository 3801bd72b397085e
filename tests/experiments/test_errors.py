"""Bad input: one line with the path or the option, exit code 1, nothing half-written."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml

from lsvision.io import write_rig
from lsvision.types import Rig
from tests.archive.archives import make_calibration, make_scan


@pytest.fixture
def scan(tmp_path):
    """A small scan without a board."""
    folder = tmp_path / "scan"
    folder.mkdir()
    write_rig(Rig(64, 1116.0, 113.84, 354.0, 8.8, 54.1), folder / "rig.yaml")
    noise = np.random.default_rng(0).integers(0, 255, (80, 64, 3), dtype=np.uint8)
    for side in ("left", "right"):
        tifffile.imwrite(folder / f"{side}.tif", noise)
    _rewrite(folder, format="lsvision-scan/1", rig="rig.yaml", line_pitch_mm=7.8, left="left.tif", right="right.tif")
    return folder


def _rewrite(folder, **changes):
    file = folder / "scan.yaml"
    data = yaml.safe_load(file.read_text()) if file.exists() else {}
    file.write_text(yaml.safe_dump({**data, **changes}))


def _shorten(folder):
    tifffile.imwrite(folder / "right.tif", np.zeros((79, 64, 3), np.uint8))


CASES = {
    "missing image": (lambda scan: (scan / "left.tif").unlink(), "left.tif"),
    "wrong version": (lambda scan: _rewrite(scan, format="lsvision-scan/9"), "scan.yaml: format"),
    "unknown key": (lambda scan: _rewrite(scan, lnie_pitch_mm=1), "scan.yaml: lnie_pitch_mm"),
    "different length": (_shorten, "scan.yaml: right"),
    "no board": (lambda scan: None, "no board"),
    "NaN pitch": (lambda scan: _rewrite(scan, line_pitch_mm=float("nan")), "scan.yaml: line_pitch_mm"),
    "python tag": (lambda scan: (scan / "scan.yaml").write_text("!!python/object:os.system {}"), "scan.yaml"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_bad_scan_is_one_line_with_its_path(case, scan, command, capsys, tmp_path):
    spoil, told = CASES[case]
    spoil(scan)
    assert command("+experiment=calibrate", f"scans=[{scan}]") == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert str(scan) in errors[0]
    assert told in errors[0]
    assert not (tmp_path / "run" / "calibration.json").exists()
    assert "Traceback" in (tmp_path / "run" / "lsvision.log").read_text()


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["+experiment=calibrate"], "scans: the list is empty"),
        (["+experiment=calibrate", "scans=[nowhere]"], "nowhere"),
        (["+experiment=calibrate", "scans=[x]", "calibration.method=jont"], "calibration.method: expected 'joint', "),
        (["+experiment=calibrate", "scans=[x]", "+spam=1"], "spam: unknown key"),
        (["+experiment=correct", "scan=x"], "calibration"),
        (["+experiment=correct", "scan=nowhere", "calibration=none.json"], "nowhere"),
        (["+experiment=simulate", "scale=0.5"], "scale"),
        ([], "+experiment=NAME"),
    ],
)
def test_a_bad_option_is_one_line_that_names_it(overrides, told, command, capsys):
    assert command(*overrides) == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 1
    assert told in errors[0]


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["+experiment=correct", "scan=x", "calibration=y", "correction.strip_rows=0"], "correction.strip_rows: "),
        (["+experiment=correct", "scan=x", "calibration=y", "export=[obj]"], "export[0]: "),
        (["+experiment=reprocess", "archive=x", "calibration=y", "output=z", "engine.workers=0"], "engine.workers: "),
    ],
)
def test_an_option_out_of_range_is_one_line(overrides, problem, command, capsys):
    assert command(*overrides) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {problem}expected ")


@pytest.mark.slow
def test_an_option_out_of_range_ends_the_program_with_one_line(tmp_path):
    options = ["+experiment=validate", "product=x", "threads=0", f"hydra.run.dir={tmp_path}"]
    arguments = [sys.executable, "-m", "lsvision.run", *options]
    done = subprocess.run(arguments, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=100)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: threads: expected ")


def test_an_unknown_option_fails_naming_it(command, capsys):
    assert command("+experiment=calibrate", "calibration.metod=joint") == 1
    assert "calibration.metod" in capsys.readouterr().err


def test_a_calibration_for_another_rig_is_refused(scan, command, capsys, tmp_path):
    other = make_calibration(tmp_path / "other.json")
    overrides = ("+experiment=correct", f"scan={scan}", f"calibration={other}")
    assert command(*overrides, folder="corrected") == 1
    told = capsys.readouterr().err
    assert str(scan) in told
    assert "another rig" in told
    assert not list((tmp_path / "corrected").glob("*.zarr"))


def test_a_product_that_fails_half_way_leaves_nothing(command, tmp_path, monkeypatch, capsys):
    from lsvision.errors import LsvisionError
    from lsvision.stages.correction.correct import Correction

    made = []

    def failing(correction, rows):
        if rows[0] > 0:
            raise LsvisionError("the disk is full")
        made.append(rows)
        return strip(correction, rows)

    strip = Correction.strip
    monkeypatch.setattr(Correction, "strip", failing)
    scan, calibration = make_scan(tmp_path / "scan", stereo=True), make_calibration(tmp_path / "calibration.json")
    overrides = ("+experiment=correct", f"scan={scan}", f"calibration={calibration}")
    assert command(*overrides, "correction.strip_rows=32", "line_motion=none", folder="corrected") == 1
    assert made == [(0, 32)]
    assert "the disk is full" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "corrected").iterdir()) == [".hydra", "lsvision.log"]


def test_help_and_configuration_are_readable(command, capsys):
    assert command("--help") == 0
    assert "+experiment=paper" in capsys.readouterr().out
    assert command("--cfg", "job", "+experiment=correct", "scan=x", "calibration=y") == 0
    shown = capsys.readouterr().out
    for option in ("height_range_mm", "strip_rows: 512", "repair_encoder: false", "matcher: auto", "output: null"):
        assert option in shown
