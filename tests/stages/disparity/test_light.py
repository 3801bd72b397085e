"""What counts as measured where light or texture are not as they should be, against the truth of rendered scans.

A wrong height that claims to be right is worse than none: what counts is the error over its sigma.
"""

from dataclasses import replace
from functools import cache

import pytest
import torch

from lsvision.geometry import focal_length_px
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_strip
from tests.stages.rendered import BOARD, FULL_RIG, scaled_rig

RIG, PITCH, LINES = scaled_rig(FULL_RIG, 8), 0.56, 160
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
RAIL, SHEET = SceneConfig("rail"), SceneConfig("sheet", pitch_deg=2.0, roll_deg=1.5)
BARE_RAIL = replace(RAIL, rail_texture=0.0)
BARE_BOARD = SceneConfig("board", pitch_deg=6.0, roll_deg=-4.0, yaw_deg=92.0, board_texture=0.0)
SOUND, NOISE = SensorConfig(supersampling=2), 1.0


@cache
def scan(scene: SceneConfig, sensor: SensorConfig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Both images, and the true disparity, px."""
    source = simulate(RIG, BOARD, scene, MOTION, sensor, Acquisition(PITCH, lines=LINES))
    left, right = (torch.cat(list(source.strips(camera))) for camera in ("left", "right"))
    depth = torch.cat(list(source.depth_strips())).double()
    offset = RIG.principal_right_px - RIG.principal_left_px
    return left, right, (focal_length_px(RIG) * RIG.baseline_mm / depth - offset).float()


def check(left: torch.Tensor, right: torch.Tensor, truth: torch.Tensor) -> float:
    """The share of the pixels that count as measured, whose errors their sigmas must cover."""
    match = measure_strip(left, right, RIG, DisparityConfig())
    ratio = ((match.disparity - truth) / match.sigma).abs()
    ratio = ratio[torch.isfinite(ratio)]
    assert ratio.square().mean().sqrt() <= 1.5
    assert (ratio > 5).float().mean() <= 0.002
    return ratio.numel() / truth.numel()


@pytest.mark.parametrize("scene", [RAIL, SHEET])
def test_sound_scans_stay_dense(scene):
    assert check(*scan(scene, SOUND)) > 0.93


@pytest.mark.parametrize("exposure", [1.9, 3.8])
@pytest.mark.parametrize(("scene", "least"), [(RAIL, 0.75), (SHEET, 0.2)])
def test_saturated_scans(scene, least, exposure):
    assert check(*scan(scene, replace(SOUND, exposure=exposure))) > least


@pytest.mark.parametrize(("scene", "least", "most"), [(BARE_RAIL, 0.75, 0.9), (BARE_BOARD, 0.3, 0.7)])
def test_surfaces_without_texture_are_not_measured(scene, least, most):
    assert least < check(*scan(scene, replace(SOUND, noise=NOISE))) < most


@pytest.mark.parametrize(("scene", "least"), [(BARE_RAIL, 0.6), (BARE_BOARD, 0.2), (RAIL, 0.7)])
def test_gloss_that_both_cameras_see_elsewhere_is_not_taken_for_the_surface(scene, least):
    left, right, truth = scan(scene, replace(SOUND, noise=NOISE))
    column = torch.arange(RIG.width_px)[:, None]

    def with_gloss(image: torch.Tensor, apart: float) -> torch.Tensor:
        light = sum(300 * torch.exp(-((column - at - apart) / 12).square() / 2) for at in (300, 440, 480))
        return (image.float() * 0.6 + light).clamp(0, 255).to(torch.uint8)

    assert check(with_gloss(left, 0.0), with_gloss(right, 24.0), truth) > least


def test_dark_scans_of_deep_pixels_are_as_good_as_bright_ones():
    dark = replace(SOUND, exposure=0.05 * 0.95, noise=0.05 * 1.5, bits=16)
    assert check(*scan(RAIL, dark)) > 0.93


def test_noise_is_not_taken_for_other_light():
    assert check(*scan(SHEET, replace(SOUND, exposure=0.05 * 0.95, noise=NOISE))) > 0.6


def test_faulty_columns_and_a_line_counter_spoil_themselves_alone():
    left, right, truth = scan(RAIL, SOUND)
    left, right = (image.to(torch.int32) * 16 for image in (left, right))
    line = torch.arange(LINES)[:, None, None]
    for image in (left, right):
        image[:, :4] = (line * 40503) % 65536
    left[:, 300], right[:, 350] = 4095, 0
    left[0, 40] = 65535
    assert check(left.to(torch.uint16), right.to(torch.uint16), truth) > 0.9
