"""``+experiment=motion``: what was found in words, table, figures, and a file that ``correct`` accepts."""

import json
from pathlib import Path

import pytest

from lsvision.io import read_line_motion, read_product
from lsvision.stages.line_motion.measure import LineMeasurement
from tests.archive.archives import make_calibration, make_scan, shaken
from tests.archive.test_line_motion import planes


@pytest.fixture
def asked(tmp_path: Path, monkeypatch) -> tuple[str, ...]:
    """A scan of 96 lines, whose motion is measured at once, and its calibration."""
    monkeypatch.setattr(
        "lsvision.archive.line_motion.measure_line_motion", lambda scan, *_: LineMeasurement(shaken(scan.lines))
    )
    scan, calibration = make_scan(tmp_path / "rail", stereo=True), make_calibration(tmp_path / "n.json")
    return f"scan={scan}", f"calibration={calibration}", "disparity.halo_lines=8"


@pytest.mark.slow
@pytest.mark.drawn
def test_all_that_it_writes(asked, command, tmp_path, capsys):
    assert command("+experiment=motion", *asked) == 0
    said = capsys.readouterr().out
    assert "motion from line to line: measured on the object's profile" in said
    assert "in depth: 0." in said
    assert "were taken for vibration" in said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["lines"] == 96
    assert summary["travel"] is None  # all colours look at one line
    assert summary["line_motion"]["corrected"] == ["dx", "dz", "roll"]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "below 12, or which is less than 1 times the errors of a line" in page
    figures = {path.name for path in (tmp_path / "run" / "figures").glob("*.png")}
    assert figures == {"line_motion.png", "line_motion_spectrum.png", "line_motion_profile.png"}
    assert not list((tmp_path / "run").glob(".depth-*"))
    file = tmp_path / "run" / "line_motion.parquet"
    assert read_line_motion(file, 96).findings == shaken(96).findings

    assert command("+experiment=correct", *asked, folder="auto") == 0
    assert command("+experiment=correct", *asked, f"line_motion={file}", folder="file") == 0
    auto, given = (read_product(tmp_path / folder / "rail.zarr") for folder in ("auto", "file"))
    assert planes(auto) == planes(given)
    assert auto.metadata["line_motion"]["sha256"] == given.metadata["line_motion"]["sha256"]
    assert "motion from line to line" in (tmp_path / "auto" / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "auto" / "figures" / "line_motion.png").stat().st_size > 1000


def test_a_scan_that_is_not_there_is_one_line(command, tmp_path, capsys):
    assert command("+experiment=motion", "scan=nowhere", f"calibration={make_calibration(tmp_path / 'n.json')}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "nowhere" in line


@pytest.mark.parametrize("experiment", ["motion", "correct"])
def test_a_section_that_cannot_be_read_is_one_line(experiment, asked, command, tmp_path, capsys):
    section = tmp_path / "worn.csv"
    section.write_text("across_mm,height_mm\n1.0,2.0\n")
    assert command(f"+experiment={experiment}", *asked, f"registration.reference={section}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{section}: expected at least 8 points, got 1" in line
