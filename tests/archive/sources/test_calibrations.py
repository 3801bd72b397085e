"""The calibration of a scan, by rig and by date."""

import dataclasses
from pathlib import Path

import pytest
import torch

from lsvision.archive import calibration_for, read_calibrations
from lsvision.errors import CalibrationError, FileFormatError, UnusableCalibrationError
from lsvision.io import read_calibration, write_calibration
from lsvision.types import DepthView, Scan, TensorImage, Travel
from tests.archive.archives import RIG, make_calibration

OTHER_RIG = dataclasses.replace(RIG, baseline_mm=300.0)
IMAGE = TensorImage(torch.zeros(2, RIG.width_px, 1))


def scan_of(rig=RIG, **attributes: str) -> Scan:
    return Scan(Path("scan"), rig, Travel(1.0), DepthView(IMAGE, IMAGE), attributes=attributes)


@pytest.fixture
def dated(tmp_path):
    for name, rig in (("spring", RIG), ("summer", RIG), ("other", OTHER_RIG)):
        make_calibration(tmp_path / f"{name}.json", rig=rig)
    (tmp_path / "calibrations.yaml").write_text(
        "- {file: spring.json, to: 2024-05-31}\n"
        "- {file: summer.json, from: 2024-06-01, to: 2024-08-31}\n"
        "- {file: other.json}\n"
    )
    return tmp_path


@pytest.mark.parametrize(
    ("day", "name"),
    [
        ("2019-01-01", "spring"),
        ("2024-05-31T23:59:59", "spring"),
        ("2024-06-01", "summer"),
        ("2024-08-31", "summer"),
    ],
)
def test_by_date_first_and_last_day_included(dated, day, name):
    assert calibration_for(scan_of(date=day), read_calibrations(dated)).path.stem == name


def test_by_rig_without_a_date(dated):
    assert calibration_for(scan_of(OTHER_RIG), read_calibrations(dated)).path.stem == "other"


def test_one_a_rig_needs_no_list(tmp_path):
    make_calibration(tmp_path / "a.json")
    make_calibration(tmp_path / "b.json", rig=OTHER_RIG)
    assert calibration_for(scan_of(OTHER_RIG), read_calibrations(tmp_path)).path.stem == "b"


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (scan_of(date="2024-09-01"), "no calibration for 2024-09-01"),
        (scan_of(), "give no date"),
        (scan_of(date="last week"), "expected a date as 2024-05-31, got 'last week'"),
        (scan_of(dataclasses.replace(RIG, baseline_mm=1.0), date="2024-05-01"), "no calibration for its rig among 3"),
    ],
)
def test_none_fits(dated, scan, message):
    with pytest.raises(CalibrationError, match=message):
        calibration_for(scan, read_calibrations(dated))


def test_more_than_one_fits(dated):
    (dated / "calibrations.yaml").write_text(
        "- {file: spring.json, to: 2024-06-15}\n- {file: summer.json, from: 2024-06-01}\n"
    )
    with pytest.raises(CalibrationError, match=r"several calibrations hold on 2024-06-10: spring.json, summer.json"):
        calibration_for(scan_of(date="2024-06-10"), read_calibrations(dated))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "expected a list of calibrations"),
        ("- {file: winter.json}", r"\[0\].file: no such file"),
        ("- {file: spring.json, from: soon}", r"\[0\].from: expected a day as 2024-05-31, got 'soon'"),
        ("- {file: spring.json, from: 2024-02-30}", r"\[0\].from: expected a day as 2024-05-31, got '2024-02-30'"),
        ("- {file: spring.json, to: 5}", r"\[0\].to: expected a day as 2024-05-31, got 5"),
        ("- {file: spring.json, from: 2024-06-01, to: 2024-05-31}", r"\[0\].to: expected a day from 2024-06-01 on"),
        ("- {file: /dev/zero}", r"\[0\].file: expected a file or folder, got a device"),
        ("- {file: .}", "expected a file, got a folder"),
        ("- 5", r"\[0\]: expected keys with values"),
        ("- {file: spring.json, until: 2024-06-01}", r"\[0\].until: unknown key"),
    ],
)
def test_lists_with_faults(dated, text, message):
    (dated / "calibrations.yaml").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_calibrations(dated)


def test_a_folder_without_any(tmp_path):
    with pytest.raises(FileFormatError, match=r"expected calibrations.yaml or calibrations as \*.json"):
        read_calibrations(tmp_path)


def spoilt(path, verdict):
    """The calibration at a path with another verdict."""
    calibration = dataclasses.replace(read_calibration(path), verdict=verdict, reasons=("it does not fit",))
    write_calibration(calibration, path)
    return path


@pytest.mark.parametrize("verdict", ["inconsistent", "not converged"])
def test_a_calibration_without_a_usable_n_is_refused_unless_its_verdict_is_accepted(tmp_path, verdict):
    file = spoilt(make_calibration(tmp_path / "a.json"), verdict)
    with pytest.raises(UnusableCalibrationError, match=rf"a\.json: the calibration is {verdict}: it does not fit"):
        read_calibrations(file)
    (found,) = read_calibrations(file, [verdict.replace(" ", "_")])
    assert found.accepted
    assert found.warning == f"{file}: the calibration is {verdict}: it does not fit"


def test_a_refused_calibration_of_a_folder_is_refused_to_its_scans_alone(dated):
    spoilt(dated / "spring.json", "inconsistent")
    calibrations = read_calibrations(dated)
    assert calibration_for(scan_of(date="2024-07-01"), calibrations).warning is None
    with pytest.raises(UnusableCalibrationError, match=r"spring\.json"):
        calibration_for(scan_of(date="2024-05-01"), calibrations)


def test_a_prior_dominated_calibration_is_used_with_a_warning(tmp_path):
    (found,) = read_calibrations(spoilt(make_calibration(tmp_path / "a.json"), "prior-dominated"))
    assert found.accepted
    assert "prior-dominated" in found.warning
