"""Corners of real photographs: all boards found, and the stereo baseline that was published for them."""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lsvision.image.board.detect import detect_board
from lsvision.image.board.refine import DetectedCorners
from lsvision.types import Board, TensorImage
from tests.combinations import crossed

BOARD = Board(10, 7, 30.0)
PRECISELY = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-9)


@cache
def corners_of(folder: Path, name: str) -> DetectedCorners:
    image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
    detected = detect_board(TensorImage(torch.from_numpy(image)[..., None]), BOARD)
    assert detected is not None, name
    assert detected.valid.all(), name
    return detected


@pytest.mark.slow
def test_stereo_baseline_of_opencvs_photographs(shared_data: Path):
    folder = shared_data / "checkerboard_opencv_stereo"
    published = json.loads((folder / "bouguet_published_results.json").read_text())
    left, right = (
        [corners_of(folder, f"{side}{pair:02d}.jpg").position.numpy().astype(np.float32) for pair in published["pairs"]]
        for side in ("left", "right")
    )
    points = [BOARD.corner_points().numpy().astype(np.float32)] * len(left)
    size = tuple(published["image_size"])
    cameras = []
    for corners in (left, right):
        rms, matrix, distortion, _, _ = cv2.calibrateCamera(points, corners, size, None, None, criteria=PRECISELY)
        assert rms < 0.19  # OpenCV's own corners, refined by cornerSubPix, leave 0.195 and 0.207 px
        cameras += [matrix, distortion]
    result = cv2.stereoCalibrate(
        points, left, right, *cameras, size, flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=PRECISELY
    )
    baseline, after = result[6].ravel(), published["after_optimisation"]
    assert (np.abs(baseline - after["T_mm"]) <= after["T_err_3sigma"]).all(), baseline


@crossed("name side", ["left01", "right05", "left13"], ["left", "right", "top", "bottom"])
def test_boards_cut_off_by_the_rim_of_a_photograph(shared_data: Path, name: str, side: str):
    folder = shared_data / "checkerboard_opencv_stereo"
    whole = corners_of(folder, f"{name}.jpg").position
    image = torch.from_numpy(cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE))[..., None]
    first, last = whole.amin(0), whole.amax(0)
    # A fifth of the corners' extent is one to two squares.
    u, v = (first + 0.2 * (last - first)).int().tolist()
    right, bottom = (last - 0.2 * (last - first)).int().tolist()
    part = {"left": image[:, u:], "right": image[:, :right], "top": image[v:], "bottom": image[:bottom]}[side]
    shift = torch.tensor([float(u) * (side == "left"), float(v) * (side == "top")]).double()
    detected = detect_board(TensorImage(part.contiguous()), BOARD)
    assert detected is not None
    assert int(detected.valid.sum()) >= 30
    assert (detected.position + shift - whole)[detected.valid].abs().max() < 0.2
