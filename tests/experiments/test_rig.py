"""The raw rig from the command line: files that agree, one line where it cannot be."""

import json

import pytest
import torch

from lsvision.geometry import ideal_rig
from lsvision.io import (
    NewScan,
    read_raw_rig,
    read_response,
    read_rig_pair,
    write_raw_rig,
    write_response,
    write_scan,
)
from lsvision.stages.rig.sightings import Sightings
from lsvision.types import RIG_QUANTITIES, CameraResponse, RawCamera, RawRig, Travel
from tests.stages.rig.boards import DATA_SHEET, Truth, first_of


@pytest.fixture
def scans(tmp_path, monkeypatch):
    """Three scans whose boards need not be found: what the cameras saw is drawn."""
    torch.manual_seed(3)
    sightings = first_of(Truth.drawn(1).scanned(3))
    blank = [torch.zeros(4, 64, 1, dtype=torch.uint8)]
    small = RawRig(64, 1000.0, 354.0, RawCamera(113.84, 31.5, 0.2186), RawCamera(113.84, 31.5, -0.2186))
    names = []
    for name in "abc":
        scan = NewScan(ideal_rig(small), Travel(0.07), blank, blank, lines=4, channels=1, raw_rig=small)
        write_scan(tmp_path / name, scan)
        names.append(str(tmp_path / name))
    monkeypatch.setattr("lsvision.experiments.rig.find_sightings", lambda scans, board: sightings)
    write_raw_rig(DATA_SHEET, tmp_path / "sheet.yaml")
    return names


def test_files_hold_the_same_rig_with_its_covariance(command, scans, tmp_path, capsys):
    assert command("+experiment=rig", f"scans=[{','.join(scans)}]", f"data_sheet={tmp_path / 'sheet.yaml'}") == 0
    data = json.loads((tmp_path / "run" / "rig_calibration.json").read_text())
    rig = read_raw_rig(tmp_path / "run" / "rig.yaml")
    assert data["rig"]["baseline_mm"] == rig.baseline_mm != DATA_SHEET.baseline_mm
    covariance = torch.tensor(data["covariance"]["values"], dtype=torch.float64)
    assert data["covariance"]["of"] == [*RIG_QUANTITIES, "n1", "n2", "n3"]
    assert dict(rig.sigma)["baseline_mm"] ** 2 == pytest.approx(float(covariance[10, 10]))
    assert data["verdict"] in capsys.readouterr().out
    assert (tmp_path / "run" / "report.html").stat().st_size > 1000


def test_the_responses_of_the_cameras_are_kept(command, scans, tmp_path):
    """Those of the data sheet, copied beside the new rig file under the names that it has."""
    gain = torch.linspace(0.5, 1.0, 7142)[:, None]
    write_response(CameraResponse(torch.zeros(7142, 1), gain), tmp_path / "of_left.tif")
    write_raw_rig(DATA_SHEET, tmp_path / "sheet.yaml", {"left": "of_left.tif"})
    assert command("+experiment=rig", f"scans=[{','.join(scans)}]", f"data_sheet={tmp_path / 'sheet.yaml'}") == 0
    assert read_rig_pair(tmp_path / "run" / "rig.yaml").response == {"left": "left_response.tif"}
    assert torch.equal(read_response(tmp_path / "run" / "left_response.tif").gain, gain)


def test_the_responses_of_the_scans_are_kept(command, scans, tmp_path):
    even = CameraResponse(torch.ones(64, 1), torch.ones(64, 1))
    write_response(even, tmp_path / "a" / "r.tif")
    write_raw_rig(read_raw_rig(tmp_path / "a" / "rig.yaml"), tmp_path / "a" / "rig.yaml", {"right": "r.tif"})
    assert command("+experiment=rig", f"scans=[{','.join(scans)}]", f"data_sheet={tmp_path / 'sheet.yaml'}") == 0
    assert read_rig_pair(tmp_path / "run" / "rig.yaml").response == {"right": "right_response.tif"}
    assert torch.equal(read_response(tmp_path / "run" / "right_response.tif").offset, even.offset)


def test_a_response_that_is_not_there_is_one_line(command, scans, tmp_path, capsys):
    write_raw_rig(DATA_SHEET, tmp_path / "sheet.yaml", {"left": "lost.tif"})
    assert command("+experiment=rig", f"scans=[{scans[0]}]", f"data_sheet={tmp_path / 'sheet.yaml'}") == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path / 'sheet.yaml'}: response.left: no such file or folder")


@pytest.mark.slow
def test_a_contradiction_is_an_exit_code_and_files(command, scans, tmp_path, monkeypatch, capsys):
    truth = Truth.drawn(1)
    n = truth.n[:, None].repeat(1, 3, 1)
    n[:, 0, 1] *= 1.05
    wrong: Sightings = first_of(truth.scanned(3, n=n))
    monkeypatch.setattr("lsvision.experiments.rig.find_sightings", lambda scans, board: wrong)
    assert command("+experiment=rig", f"scans=[{','.join(scans)}]", f"data_sheet={tmp_path / 'sheet.yaml'}") == 1
    assert "the calibration is inconsistent" in capsys.readouterr().err
    assert (tmp_path / "run" / "rig_calibration.json").exists()


def test_a_missing_data_sheet_is_one_line(command, scans, capsys):
    assert command("+experiment=rig", f"scans=[{scans[0]}]", "data_sheet=nowhere.yaml") == 1
    assert capsys.readouterr().err == "error: nowhere.yaml: no such file\n"


@pytest.mark.slow
def test_a_study_of_rigs(command, tmp_path):
    board = ("board.columns=7", "board.rows=5", "board.square_mm=52")
    assert command("+experiment=study_rig", "runs=3", "axes.boards=[2,4]", "axes.sideways=null", *board) == 0
    points = json.loads((tmp_path / "run" / "summary.json").read_text())["points"]
    assert [point["boards"] for point in points] == [2, 4]
    assert points[0]["stated_um"] > 2 * points[1]["stated_um"]
    assert all(3 < point["nees"] < 40 for point in points)


def test_an_unknown_condition_is_one_line(command, capsys):
    assert command("+experiment=study_rig", "+axes.weather=[1]") == 1
    assert capsys.readouterr().err.startswith("error: axes.weather: unknown; expected one of boards, tilt_deg")
