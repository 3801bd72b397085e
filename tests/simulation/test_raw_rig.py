"""Raw cameras in the renderer: where they see corners, and what their files say."""

import dataclasses

import pytest
import torch

from lsvision.geometry import RawPair, ideal_rig, scaled_raw_rig, transform
from lsvision.image.board.detect import detect_board
from lsvision.simulation import Acquisition, EncoderConfig, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.types import Board, RawCamera, RawRig, TensorImage
from tests.raw_cameras import RAW as PLAIN

BOARD = Board(12, 9, 30.0)
RAW = dataclasses.replace(PLAIN, color_spacing_lines=(-4.0, 0.0, 4.0))
TILTED = SceneConfig(pitch_deg=3.0, roll_deg=-2.0, yaw_deg=92.0)
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)


def source(scale: int = 8, motion: MotionConfig = MOTION, **acquisition):
    raw = dataclasses.replace(scaled_raw_rig(RAW, scale), color_spacing_lines=(0.0, 0.0, 0.0))
    return simulate(raw, BOARD, TILTED, motion, SensorConfig(supersampling=2), Acquisition(0.07 * scale, **acquisition))


def test_corners_lie_where_the_raw_pair_sees_them():
    made = source()
    points, pair, n = (
        transform(made.pose.rotation, made.pose.translation, BOARD.corner_points()),
        RawPair.of(made.raw_rig),
        made.trajectory.n,
    )
    for seen, corners in zip((pair.seen_left(points, n), pair.seen_right(points, n)), made.corners(), strict=True):
        expected = torch.stack([seen.column, seen.travel / 0.56], dim=-1)
        torch.testing.assert_close(corners, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("camera", ["left", "right"])
def test_rendered_corners_lie_where_the_truth_says(camera):
    shaken = dataclasses.replace(MOTION, vibration_x_mm=0.1, vibration_z_mm=0.1, vibration_roll_deg=0.02)
    wobble = EncoderConfig(enabled=True, wobble_mm=0.8)
    made = source(motion=shaken, encoder=wobble)
    image = TensorImage(torch.cat(list(made.strips(camera))))
    assert image.shape == (made.lines, 893, 3)
    found = detect_board(image, BOARD)
    assert found is not None
    assert found.valid.sum() > 80
    off = (found.position - made.corners()[camera == "right"])[found.valid]
    assert (off.square().mean(0).sqrt() < 0.03).all()


def test_larger_pixels_see_the_same_field():
    scaled = scaled_raw_rig(RAW, 7)
    points = torch.tensor([[50.0, 10.0, 790.0], [300.0, 20.0, 800.0]], dtype=torch.float64)
    n = torch.tensor([0.02, 1.01, -0.01], dtype=torch.float64)
    for view in ("seen_left", "seen_right"):
        fine, coarse = (getattr(RawPair.of(raw), view)(points, n) for raw in (RAW, scaled))
        torch.testing.assert_close((fine.column + 0.5) / 7 - 0.5, coarse.column, rtol=0, atol=1e-9)
        torch.testing.assert_close(fine.travel, coarse.travel, rtol=0, atol=1e-12)
    assert scaled.color_spacing_lines == (-4 / 7, 0.0, 4 / 7)
    with pytest.raises(ValueError, match="scale must be at least 1"):
        scaled_raw_rig(RAW, 0.5)


def test_truth_holds_the_cameras():
    made = source()
    assert made.truth()["rig"] == dataclasses.asdict(made.raw_rig)
    assert made.rig == ideal_rig(made.raw_rig)


def test_raw_cameras_that_are_rectified_render_the_same_images():
    rig = ideal_rig(
        RawRig(446, 160.0, 354.0, RawCamera(113.84, 64.6), RawCamera(113.84, 380.7)),
    )
    raw = RawRig(446, 160.0, 354.0, RawCamera(113.84, 64.6), RawCamera(113.84, 380.7))
    one, other = (
        simulate(cameras, BOARD, TILTED, MOTION, SensorConfig(supersampling=1, noise=0.0), Acquisition(1.12, lines=200))
        for cameras in (rig, raw)
    )
    for camera in ("left", "right"):
        a, b = (torch.cat(list(each.strips(camera))).int() for each in (one, other))
        assert (a - b).abs().max() <= 1
