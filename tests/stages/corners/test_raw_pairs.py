"""Corners of raw pairs: against the truth of another renderer, and as a rectified pair where that is what they are."""

import dataclasses
from pathlib import Path

import pytest
import torch

from lsvision.geometry import scaled_rig
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.corners.find import locate_in_images, measure_corners
from lsvision.stages.corners.rows import row_difference
from lsvision.types import RawCamera, RawRig
from tests.stages.other_renderer import raw_located, raw_scan, raw_scans, true_motion, true_points
from tests.stages.rendered import BOARD, FULL_RIG, located, simulation, stereo_scan


def test_corners_of_another_renderers_raw_images(shared_data: Path):
    scan = raw_scan(shared_data, "raw_a")
    located = raw_located(shared_data, "raw_a")
    nominal = measure_corners(scan, BOARD, located)
    corners = measure_corners(scan, BOARD, located, n=true_motion(scan))
    assert corners.valid.all()
    error = corners.points - true_points(scan)
    assert (error.square().mean(0).sqrt() < torch.tensor([0.01, 0.01, 0.025])).all()
    assert (error.mean(0).abs() < 0.005).all()
    # Half a millimetre of travel between the planes, of an object that moves sideways by 3 %.
    assert (nominal.points - corners.points)[:, 0].abs().max() > 0.01
    difference = row_difference(corners)
    assert abs(difference.lines) < 0.02


@pytest.mark.slow
def test_joint_calibration_of_another_renderers_raw_scans(shared_data: Path):
    scans = raw_scans(shared_data)
    seen, n = [locate_in_images(scan, BOARD) for scan in scans], None
    for _ in range(2):
        boards = [measure_corners(scan, BOARD, found, n=n) for scan, found in zip(scans, seen, strict=True)]
        calibration = calibrate(boards, scans[0].rig, CalibrationConfig())
        n = calibration.motion.n
    error = (n - true_motion(scans[0])) / calibration.motion.sigma
    assert calibration.verdict == "determined"
    assert (error.abs() < 3).all()
    squared = []
    for scan, corners in zip(scans, boards, strict=True):
        off = (corners.points - true_points(scan))[corners.valid]
        squared.append((off * torch.linalg.solve(corners.covariance[corners.valid], off[..., None])[..., 0]).sum(-1))
    assert torch.cat(squared).mean() / 3 < 1.6


def test_raw_cameras_without_turn_and_distortion_give_the_same_bits():
    scan, found = stereo_scan(simulation()), located(simulation())
    rig = scaled_rig(FULL_RIG, 16)
    raw = RawRig(
        rig.width_px, rig.pixel_pitch_um, rig.baseline_mm,
        RawCamera(rig.focal_length_mm, rig.principal_left_px), RawCamera(rig.focal_length_mm, rig.principal_right_px),
    )  # fmt: skip
    one, other = (measure_corners(each, BOARD, found) for each in (scan, dataclasses.replace(scan, raw_rig=raw)))
    for field in ("points", "left_px", "right_px"):
        torch.testing.assert_close(getattr(one, field), getattr(other, field), rtol=0, atol=0, equal_nan=True)
    # The last bit of products of matrices depends on where they lie in memory.
    torch.testing.assert_close(one.covariance, other.covariance, rtol=1e-9, atol=0, equal_nan=True)
