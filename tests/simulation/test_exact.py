"""Rendered corners lie where the model predicts, in our images and in another program's."""

import dataclasses
import json

import cv2
import pytest
import torch

from lsvision.geometry import scaled_rig
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    simulate,
)
from lsvision.types import Board, Pose, Rig
from tests.simulation.corner_fit import fit_corners

SHARED_N = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=0.985)
POSES = [(8.0, -3.0, 5.0), (0.0, 0.0, 0.0), (-8.0, 6.0, 40.0), (-4.0, -7.0, 95.0)]


def _worst(simulation, whole, board):
    errors = []
    for camera, truth in zip(("left", "right"), simulation.corners(), strict=True):
        found = fit_corners(whole(simulation, camera).mean(-1), truth, board.inner)
        errors.append((found - truth).abs().max())
    return float(torch.stack(errors).max())


@pytest.mark.parametrize(("pitch", "roll", "yaw"), POSES)
def test_corners_agree_with_the_model_to_a_hundredth_of_a_pixel(full_rig, board, whole, pitch, roll, yaw):
    scene = SceneConfig(pitch_deg=pitch, roll_deg=roll, yaw_deg=yaw, board_texture=0.0)
    sensor = SensorConfig(noise=0.0, bits=16)
    simulation = simulate(scaled_rig(full_rig, 16), board, scene, SHARED_N, sensor, Acquisition(1.12))
    assert _worst(simulation, whole, board) < 0.01


def test_corners_are_exact_at_a_quarter_of_the_pixels(full_rig, whole):
    board = Board(5, 4, 30.0)
    scene = SceneConfig(pitch_deg=-6.0, roll_deg=4.0, yaw_deg=12.0, board_texture=0.0)
    simulation = simulate(
        scaled_rig(full_rig, 4), board, scene, SHARED_N, SensorConfig(noise=0.0, bits=16), Acquisition(0.28)
    )
    assert _worst(simulation, whole, board) < 0.01


def test_corners_are_exact_under_vibration_and_uneven_lines(small_rig, board, clean, whole):
    motion = dataclasses.replace(
        SHARED_N,
        vibration_x_mm=0.6,
        vibration_z_mm=0.5,
        vibration_roll_deg=0.1,
        vibration_wavelengths_mm=[577.0, 391.0],  # long, so that an edge stays straight within a corner's window
    )
    scene = SceneConfig(pitch_deg=5.0, yaw_deg=10.0, board_texture=0.0)
    simulation = simulate(
        small_rig,
        board,
        scene,
        motion,
        clean,
        Acquisition(0.56, encoder=EncoderConfig(True, wobble_wavelengths_mm=[390.0])),
    )
    still = simulate(small_rig, board, scene, SHARED_N, clean, Acquisition(0.56))
    moved = (simulation.corners()[0] - still.corners()[0]).abs().amax(0)
    assert (moved > 0.5).all()  # px and lines: large enough to matter
    assert _worst(simulation, whole, board) < 0.01


@pytest.mark.parametrize(
    "name", ["tilt_a", "tilt_c", *(pytest.param(f"tilt_{name}", marks=pytest.mark.slow) for name in "bd")]
)
def test_corners_of_another_renderer_lie_where_the_model_predicts(shared_data, board, clean, whole, name):
    folder = shared_data / "scans_other_renderer" / name
    truth = json.loads((folder / "truth.json").read_text())
    rig = Rig(893, 80.0, 113.84, 354.0, 129.93650395281713, 762.0634960471829)
    pose = Pose(*(torch.tensor(truth[key], dtype=torch.float64) for key in ("R", "T")))
    simulation = simulate(rig, board, SceneConfig(), SHARED_N, clean, Acquisition(0.56, lines=truth["lines"]))
    simulation = dataclasses.replace(simulation, pose=pose)
    torch.testing.assert_close(simulation.trajectory.n.tolist(), truth["n"])
    for camera, predicted in zip(("left", "right"), simulation.corners(), strict=True):
        theirs = torch.from_numpy(cv2.imread(str(folder / f"{camera}.tif"))).double().mean(-1)
        # Its edges are hard and sampled at thirds of a pixel; blurred edges can be located by a fit.
        soft = torch.from_numpy(cv2.GaussianBlur(theirs.numpy(), (9, 9), 1.0))
        error = fit_corners(soft, predicted, board.inner) - predicted
        assert error.square().mean().sqrt() < 0.05  # px
        assert error.mean(0).abs().max() < 0.02
        ours = whole(simulation, camera).mean(-1) / 65535
        plain = (ours < 0.08) | (ours > 0.5)  # well inside a black or a white area
        assert ((ours < 0.08) == (theirs < 70))[plain].double().mean() > 0.999


def test_rotation_follows_the_angles_of_the_other_renderer(shared_data, small_rig, board, motion, clean):
    truth = json.loads((shared_data / "scans_other_renderer" / "tilt_b" / "truth.json").read_text())
    pitch, roll, yaw = truth["args"]["pose"]
    simulation = simulate(small_rig, board, SceneConfig("board", pitch, roll, yaw), motion, clean, Acquisition(0.56))
    torch.testing.assert_close(simulation.truth()["R"], truth["R"])
