"""A calibration is for the rig that it was made with, raw cameras and their planes included."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from lsvision.errors import CalibrationError
from lsvision.geometry import ideal_rig
from lsvision.io import check_rig_match, read_calibration, read_scan, write_calibration
from lsvision.types import Calibration, RawCamera, RawRig, Rig, Scan, ViewPlane

RAW = RawRig(893, 80.0, 354.0, RawCamera(114.1, 446.0, 0.2212), RawCamera(113.6, 447.0, -0.2203), ViewPlane(0.25))


@pytest.fixture
def scan(make_scan: Callable[..., Path]) -> Scan:
    return read_scan(make_scan())


def raw_pair(calibration: Calibration, scan: Scan, ours: RawRig, theirs: RawRig) -> tuple[Calibration, Scan]:
    """A calibration and a scan of raw cameras."""
    return (
        replace(calibration, rig=ideal_rig(ours), raw_rig=ours),
        replace(scan, rig=ideal_rig(theirs), raw_rig=theirs),
    )


def test_another_focal_length_is_another_rig(calibration: Calibration, scan: Scan) -> None:
    check_rig_match(calibration, scan)
    other = replace(calibration, rig=replace(calibration.rig, focal_length_mm=120.0))
    with pytest.raises(CalibrationError, match=r"scan: .* another rig: focal_length_mm 120.0, the scan's is 113.84"):
        check_rig_match(other, scan)


def test_another_view_plane_is_another_rig_with_the_same_ideal_pair(calibration: Calibration, scan: Scan) -> None:
    check_rig_match(*raw_pair(calibration, scan, RAW, RAW))
    tilted = replace(RAW, view_plane=ViewPlane(0.25, slope_x=0.003))
    assert ideal_rig(tilted) == ideal_rig(RAW)
    with pytest.raises(CalibrationError, match=r"right.view_plane.slope_x 0.003, the scan's is 0"):
        check_rig_match(*raw_pair(calibration, scan, tilted, RAW))


def test_the_same_cameras_known_better_are_the_same_rig(calibration: Calibration, scan: Scan) -> None:
    known = replace(RAW, sigma=(("baseline_mm", 0.1),), covariance=((1.0,) * 14,) * 14)
    check_rig_match(*raw_pair(calibration, scan, known, RAW))


def test_rectified_cameras_match_in_either_format(calibration: Calibration, scan: Scan) -> None:
    rig = Rig(893, 80.0, 113.84, 354.0, 130.0, 762.0)
    flat = RawRig(893, 80.0, 354.0, RawCamera(113.84, 130.0), RawCamera(113.84, 762.0))
    check_rig_match(replace(calibration, rig=rig), replace(scan, rig=rig, raw_rig=flat))
    check_rig_match(replace(calibration, rig=rig, raw_rig=flat), replace(scan, rig=rig))
    with pytest.raises(CalibrationError, match="its cameras are raw, the scan's are rectified"):
        check_rig_match(replace(calibration, rig=ideal_rig(RAW), raw_rig=RAW), replace(scan, rig=ideal_rig(RAW)))


def test_a_file_keeps_the_raw_rig(calibration: Calibration, scan: Scan, tmp_path: Path) -> None:
    """Turns are in degrees in a file, and may come back a rounding away."""
    for turn in (0.2212, 0.2199, 0.218561234567, 0.3):
        raw = replace(RAW, left=replace(RAW.left, turn_rad=turn))
        made, mine = raw_pair(calibration, scan, raw, raw)
        write_calibration(made, tmp_path / "calibration.json")
        back = read_calibration(tmp_path / "calibration.json")
        assert back.raw_rig is not None
        assert back.raw_rig.view_plane == RAW.view_plane
        check_rig_match(back, mine)
