"""Raw pairs: depth against the truth of two renderers, the same bits from any strip, and rectified cameras."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import pytest
import torch

from lsvision.geometry import focal_length_px, scaled_raw_rig, slope_at, travel_at
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    simulate,
)
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of, relation_of_scan
from lsvision.stages.disparity.rectify import RectifiedPair
from lsvision.types import Pose, RawCamera, RawRig, Scan, StereoPair, TensorImage, Travel, ViewPlane
from tests.raw_cameras import RAW
from tests.stages.other_renderer import raw_scan
from tests.stages.rendered import BOARD, MOTION, simulation, stereo_scan

SCALE = 8
SHEET = SceneConfig("sheet", pitch_deg=2.0, roll_deg=1.5, margin_mm=5.0, sheet_height_mm=80.0, texture_mm=0.8)


def rendered(raw: RawRig = RAW, motion: MotionConfig = MOTION, **acquisition) -> tuple[Simulation, Scan]:
    """A sheet under raw cameras."""
    source = simulate(
        scaled_raw_rig(raw, SCALE), BOARD, SHEET, motion, SensorConfig(supersampling=2),
        Acquisition(0.07 * SCALE, **acquisition),
    )  # fmt: skip
    images = StereoPair(*(TensorImage(torch.cat(list(source.strips(camera)))) for camera in ("left", "right")))
    return source, Scan(Path("raw"), source.rig, source.travel, images, raw_rig=source.raw_rig)


@cache
def sheet() -> tuple[Simulation, Scan]:
    return rendered()


def error_px(scan: Scan, z: torch.Tensor, pose: Pose, n: torch.Tensor, size: tuple[float, float]) -> torch.Tensor:
    """Error of depths of a plane in px of disparity; NaN where none was measured, and outside of the plane."""
    lines, columns = (torch.arange(length, dtype=torch.float64) for length in z.shape)
    slope, normal = slope_at(scan.rig, columns), pose.rotation[:, 2]
    travel = travel_at(scan.travel, lines)[:, None]
    true = (normal @ pose.translation - travel * (n @ normal)) / (slope * normal[0] + normal[2])
    still = torch.stack([slope * true, torch.zeros_like(true), true], dim=-1) + travel[..., None] * n
    place = (still - pose.translation) @ pose.rotation
    inside = ((place[..., :2] > 5) & (place[..., :2] < torch.tensor(size) - 5)).all(-1)
    scale = focal_length_px(scan.rig) * scan.rig.baseline_mm
    return (scale / z - scale / true).masked_fill(~inside, torch.nan), inside


def test_depth_of_a_sheet_under_raw_cameras():
    source, scan = sheet()
    n = source.trajectory.n
    depth = depth_of(scan, n=n).read(0, scan.lines)
    assert depth.z.shape == (scan.lines, scan.rig.width_px)
    error, inside = error_px(scan, depth.z, source.pose, n, (SHEET.sheet_width_mm, SHEET.sheet_height_mm))
    found = error[error.isfinite()]
    assert len(found) > 0.99 * int(inside.sum())
    assert found.square().mean().sqrt() < 0.06
    assert abs(found.median()) < 0.01
    normalised = error / (depth.sigma * focal_length_px(scan.rig) * scan.rig.baseline_mm / depth.z.square())
    assert 0.7 < normalised.abs().nanmedian() / 0.6745 < 1.3
    rows = relation_of_scan(scan, DisparityConfig()).rows
    assert abs(rows.lines) < 0.05


def test_a_wrong_plane_is_noticed_as_lines_out_of_step():
    _, scan = sheet()
    plane = dataclasses.replace(scan.raw_rig.view_plane, offset_mm=0.25 - 2 * 0.56)
    rows = relation_of_scan(dataclasses.replace(scan, raw_rig=dataclasses.replace(scan.raw_rig, view_plane=plane)),
                            DisparityConfig()).rows  # fmt: skip
    assert rows.whole == -2


def test_depth_of_another_renderers_shaded_sheet(shared_data: Path):
    scan = raw_scan(shared_data, "raw_sheet_shaded")
    truth = json.loads((scan.path / "truth.json").read_text())
    pose = Pose(*(torch.tensor(truth[key], dtype=torch.float64) for key in ("R", "T")))
    n = torch.tensor(truth["n"], dtype=torch.float64)
    depth = depth_of(scan, n=n)
    error, inside = error_px(scan, depth.read(200, 500).z, _at_line(pose, n, scan.travel, 200), n, (360.0, 270.0))
    found = error[error.isfinite()]
    assert len(found) > 0.99 * int(inside.sum()) > 100_000
    assert found.square().mean().sqrt() < 0.1
    assert abs(found.median()) < 0.02


def _at_line(pose: Pose, n: torch.Tensor, travel: Travel, line: int) -> Pose:
    """The pose counted from a line."""
    return Pose(pose.rotation, pose.translation - travel_at(travel, torch.tensor(float(line)).double()) * n)


@pytest.mark.parametrize("matcher", ["sgbm", "coarse_to_fine"])
def test_lines_do_not_depend_on_the_strip(matcher):
    _, scan = sheet()
    config = DisparityConfig(matcher=matcher, block_lines=64)
    whole = depth_of(scan, config).read(0, scan.lines)
    for start, stop in ((100, 140), (0, 64), (50, 70)):
        part = depth_of(scan, config).read(start, stop)
        torch.testing.assert_close(part.z, whole.z[start:stop], rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(part.sigma, whole.sigma[start:stop], rtol=0, atol=0, equal_nan=True)


def test_uneven_travel_shears_by_what_the_encoder_says():
    wobble = EncoderConfig(enabled=True, wobble_mm=0.8, wobble_wavelengths_mm=(60.0, 35.0))
    source, scan = rendered(encoder=wobble)
    n = source.trajectory.n
    error, _ = error_px(scan, depth_of(scan, n=n).read(0, scan.lines).z, source.pose, n, (360.0, 80.0))
    assert error[error.isfinite()].square().mean().sqrt() < 0.06
    assert abs(relation_of_scan(scan, DisparityConfig()).rows.lines) < 0.05


def test_planes_that_are_one_leave_rows_alone():
    raw = dataclasses.replace(scaled_raw_rig(RAW, SCALE), view_plane=ViewPlane())
    scan = dataclasses.replace(sheet()[1], raw_rig=raw)
    pair = RectifiedPair.of(scan, DisparityConfig())
    assert pair is not None
    assert torch.equal(pair.images.left.read(7, 20), scan.left.read(7, 20)[:, pair.columns])
    assert pair.images.right.shape == pair.images.left.shape
    assert pair.rows_of(7, 20) == range(7, 20)


def test_cameras_that_are_rectified_already_give_the_same_bits():
    scan = stereo_scan(simulation(SceneConfig("sheet", margin_mm=0.0, texture_mm=1.5)))
    rig = scan.rig
    raw = RawRig(
        rig.width_px, rig.pixel_pitch_um, rig.baseline_mm,
        RawCamera(rig.focal_length_mm, rig.principal_left_px), RawCamera(rig.focal_length_mm, rig.principal_right_px),
    )  # fmt: skip
    one, other = (depth_of(each).read(0, scan.lines) for each in (scan, dataclasses.replace(scan, raw_rig=raw)))
    torch.testing.assert_close(one.z, other.z, rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(one.sigma, other.sigma, rtol=0, atol=0, equal_nan=True)
