"""``+experiment=response``: references in, files out that make scans even where they are read."""

import json
import shutil
from pathlib import Path

import polars
import pytest
import torch
import yaml

from lsvision.archive.identity import stamp_of
from lsvision.io import NewScan, read_response, read_scan, write_scan
from lsvision.stages.line_motion.measure import LineMeasurement
from lsvision.stages.response.wander import WanderGains
from lsvision.types import Travel
from tests.archive.archives import RIG, make_calibration, make_scan, shaken
from tests.stages.response.references import WIDTH, make

WIDE = RIG.__class__(**{**vars(RIG), "width_px": WIDTH})


@pytest.fixture
def references(tmp_path: Path) -> tuple[Path, Path]:
    """The scans of a dark and a white reference."""
    left, right = make(0), make(1)
    for name in ("dark", "white"):
        images = [[getattr(made, name).tensor] for made in (left, right)]
        write_scan(tmp_path / name, NewScan(WIDE, Travel(1.0), *images, lines=400))
    return tmp_path / "dark", tmp_path / "white"


def test_all_that_it_writes_and_that_scans_are_read_with_it(references, command, tmp_path, capsys):
    dark, white = references
    assert command("+experiment=response", f"dark={dark}", f"white={white}") == 0
    said = capsys.readouterr().out
    assert "left camera: gain 0." in said
    run = tmp_path / "run"
    data = json.loads((run / "response.json").read_text())
    assert data["format"] == "lsvision-response/1"
    assert data["left"]["blind_columns"] == []
    assert 0 < data["right"]["gain"]["relative_sigma"] < 0.005
    assert [item["path"] for item in data["provenance"]["scans"]] == [str(dark), str(white)]
    assert len(polars.read_parquet(run / "response.parquet")) == 2 * WIDTH * 3
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "Gain by column" in page
    assert {file.name for file in (run / "figures").glob("*.png")} == {
        "response_gain.png", "response_offset.png", "response_sigma.png",
    }  # fmt: skip

    before = stamp_of(white)
    for name in ("left_response.tif", "right_response.tif", "rig.yaml"):
        shutil.copy(run / name, white / name)
    assert stamp_of(white) != before
    even = read_scan(white).images.left.read(0, 400).float()
    columns = even.median(0).values
    assert float((columns / columns.mean() - 1).abs().quantile(0.95)) < 0.008  # half a code of 180 is 0.3 %
    assert torch.equal(read_response(run / "left_response.tif").blind, torch.zeros(WIDTH, dtype=torch.bool))
    # References are read as they were taken: the same again gives the same.
    assert command("+experiment=response", f"dark={dark}", f"white={white}", folder="again") == 0
    for name in ("left_response.tif", "right_response.tif"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()


def test_a_rig_without_response_is_written_with_it(references, command, tmp_path):
    dark, white = references
    assert command("+experiment=response", f"dark={dark}", f"white={white}") == 0
    data = yaml.safe_load((tmp_path / "run" / "rig.yaml").read_text())
    assert data.pop("response") == {"left": "left_response.tif", "right": "right_response.tif"}
    assert data == yaml.safe_load((white / "rig.yaml").read_text())


def test_what_cannot_be_used_is_one_line(references, command, capsys):
    dark, white = references
    assert command("+experiment=response", f"dark={dark}") == 1
    assert "error: dark, white: expected the scans of both references" in capsys.readouterr().err
    assert command("+experiment=response", f"dark={dark}", f"white={dark}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {dark}: left: is no brighter than the dark reference")
    assert command("+experiment=response", f"dark={dark}", f"white={white}", "estimate.blocks=1") == 1
    assert "estimate.blocks: expected a whole number >= 2, got 1" in capsys.readouterr().err


def test_an_archive_that_cannot_be_used_is_one_line(command, tmp_path, capsys):
    scan, calibration = make_scan(tmp_path / "scans" / "a", stereo=True), make_calibration(tmp_path / "n.json")
    assert command("+experiment=response", f"archive={scan.parent}") == 1
    assert "error: archive: expected calibration=FILE with it" in capsys.readouterr().err
    assert command("+experiment=response", f"archive={scan.parent}", f"calibration={calibration}") == 1
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert line.startswith("error: archive: ")
    assert not (tmp_path / "run" / "left_response.tif").exists()


def test_an_archive_whose_objects_wander(command, tmp_path, capsys, monkeypatch):
    """Its command from end to end, with the motion and the gains of its scans given."""
    scan, calibration = make_scan(tmp_path / "scans" / "a", stereo=True), make_calibration(tmp_path / "n.json")
    gains = WanderGains(0.05 * torch.randn(64, 3, dtype=torch.float64), torch.full((64, 3), 1e-3), 40.0, 3.0)
    monkeypatch.setattr(
        "lsvision.experiments.archive_response.measured_line_motion",
        lambda scan, *_: LineMeasurement(shaken(scan.lines)),
    )
    monkeypatch.setattr(
        "lsvision.experiments.archive_response.gains_of_scan", lambda *_: {"left": gains, "right": gains}
    )
    assert command("+experiment=response", f"archive={scan.parent}", f"calibration={calibration}") == 0
    assert "gains of waves up to 40 columns; longer ones, as vignetting, are left" in capsys.readouterr().out
    data = json.loads((tmp_path / "run" / "response.json").read_text())
    assert data["method"] == "archive"
    assert (data["observed_px"], data["wander_px"]) == (40.0, {"a": 3.0})
    written = read_response(tmp_path / "run" / "right_response.tif")
    assert torch.allclose(written.gain, gains.log_gain.exp().float())
    assert not bool(written.offset.any())


def test_a_white_that_did_not_move_is_refused(command, tmp_path, capsys):
    left = make(0, dirt=0.3, speed=0.0)
    right = make(1, dirt=0.3, speed=0.0)
    for name in ("dark", "white"):
        images = [[getattr(made, name).tensor] for made in (left, right)]
        write_scan(tmp_path / name, NewScan(WIDE, Travel(1.0), *images, lines=400))
    assert command("+experiment=response", f"dark={tmp_path / 'dark'}", f"white={tmp_path / 'white'}") == 1
    assert "stands in the columns of both cameras, +0 px apart" in capsys.readouterr().err
