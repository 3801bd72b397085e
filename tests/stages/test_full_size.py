"""Corners and disparities of the full camera's width against the renderer's truth."""

import cv2
import pytest
import torch

from lsvision.geometry import focal_length_px
from lsvision.image.board.detect import detect_board
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import StripMatch, measure_strip
from lsvision.types import TensorImage
from tests.stages.rendered import BOARD, FULL_RIG

pytestmark = pytest.mark.slow
PITCH = 0.07


@pytest.mark.parametrize("yaw", [0.0, 37.0, 90.0])
def test_corners_at_full_size(yaw):
    scene = SceneConfig("board", 2.0, 1.5, yaw, texture_mm=0.15, board_texture=0.0)
    motion = MotionConfig(angle_x_deg=3.0, stretch=1.0246)
    source = simulate(
        FULL_RIG, BOARD, scene, motion, SensorConfig(noise=3.0, blur_px=1.0, supersampling=2), Acquisition(PITCH)
    )
    detected = detect_board(TensorImage(torch.cat(list(source.strips("left")))), BOARD)
    assert detected is not None
    assert detected.valid.all()
    error = detected.position - source.corners()[0]
    rms = error.square().mean(0).sqrt()
    assert (rms <= 0.015).all()
    assert (error.mean(0).abs() <= 0.005).all()
    predicted = detected.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    assert ((rms / predicted - 1).abs() <= 0.3).all()


@pytest.mark.parametrize("kind", ["rail", "sheet"])
def test_disparity_at_full_size(kind):
    tilt = {} if kind == "rail" else {"pitch_deg": 1.5, "roll_deg": -1.0, "yaw_deg": 3.0}
    source = simulate(
        FULL_RIG,
        BOARD,
        SceneConfig(kind, texture_mm=0.15, **tilt),
        MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246),
        SensorConfig(noise=2.0, supersampling=2),
        Acquisition(PITCH, lines=512),
    )
    left, right = (torch.cat(list(source.strips(camera))) for camera in ("left", "right"))
    depth = torch.cat(list(source.depth_strips())).double()
    convergence = FULL_RIG.principal_right_px - FULL_RIG.principal_left_px
    truth = focal_length_px(FULL_RIG) * FULL_RIG.baseline_mm / depth - convergence

    def figures(match):
        error = match.disparity - truth
        known, close = torch.isfinite(error), error.abs() <= 1
        within = error[close]
        ratio = (within.abs() / match.sigma[close]).nanmedian() / 0.6745
        return known.double().mean(), (known & ~close).double().mean(), within, ratio

    grey = (cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY) for image in (left, right))
    matcher = cv2.StereoSGBM.create(
        minDisparity=-168, numDisparities=336, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=10,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    found = torch.from_numpy(matcher.compute(*grey)).float() / 16
    found = torch.where(found >= -168, found, torch.nan)
    peer = figures(StripMatch(found, torch.full_like(found, torch.nan)))
    config = DisparityConfig(matcher="coarse_to_fine", largest_sigma_px=0.2)
    ours = figures(measure_strip(left, right, FULL_RIG, config))
    assert ours[0] >= peer[0]
    assert ours[1] <= peer[1]
    assert ours[2].square().mean().sqrt() <= 0.6 * peer[2].square().mean().sqrt()
    assert ours[2].mean().abs() <= 0.01
    assert abs(ours[3] - 1) < 0.3
