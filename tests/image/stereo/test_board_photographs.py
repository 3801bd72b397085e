"""Sigma of disparities on photographs of boards, whose corners show the plane; where the shared data are present."""

import json

import cv2
import numpy as np
import pytest
import torch

from lsvision.geometry import focal_length_px, zero_disparity_mm
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_strip
from lsvision.types import Rig

pytestmark = pytest.mark.slow
INNER, SQUARE_MM, SIZE = (9, 6), 30.0, (640, 480)
NAMES = ("02", "05", "08", "12")
SHIFT_PX = 80.0  # of the right principal point: the plane of zero disparity then lies at some distance


@pytest.fixture(scope="module")
def boards(shared_data):
    """Rig, and per board the rectified images and the corners in both."""
    folder = shared_data / "checkerboard_opencv_stereo"
    assert json.loads((folder / "bouguet_published_results.json").read_text())
    pairs = [[cv2.imread(str(folder / f"{side}{name}.jpg"), 0) for side in ("left", "right")] for name in NAMES]
    seen = [[_corners(image) for image in pair] for pair in pairs]
    left, right = ([corners[side] for corners in seen] for side in (0, 1))
    points = np.zeros((54, 3), np.float32)
    points[:, :2] = SQUARE_MM * np.mgrid[: INNER[0], : INNER[1]].T.reshape(-1, 2)
    board = [points] * len(NAMES)
    cameras = [cv2.calibrateCamera(board, corners, SIZE, None, None)[1:3] for corners in (left, right)]
    found = cv2.stereoCalibrate(board, left, right, *cameras[0], *cameras[1], SIZE)
    matrices, (rotation, translation) = (found[1:3], found[3:5]), found[5:7]
    turns = cv2.stereoRectify(*matrices[0], *matrices[1], SIZE, rotation, translation, flags=0, alpha=0)[:4]
    turns[3][0, 2] += SHIFT_PX
    focal, baseline = float(turns[2][0, 0]), float(np.linalg.norm(translation))
    rig = Rig(SIZE[0], 10.0, focal / 100, baseline, float(turns[2][0, 2]), float(turns[3][0, 2]))
    sides = [(*matrices[side], turns[side], turns[2 + side]) for side in (0, 1)]
    maps = [cv2.initUndistortRectifyMap(*side, SIZE, cv2.CV_32FC1) for side in sides]
    return rig, [
        (
            [cv2.remap(image, *each, cv2.INTER_CUBIC) for image, each in zip(pair, maps, strict=True)],
            [
                cv2.undistortPoints(each[:, None], k, d, R=r, P=p)[:, 0]
                for each, (k, d, r, p) in zip(corners, sides, strict=True)
            ],
        )
        for pair, corners in zip(pairs, seen, strict=True)
    ]


def _corners(image: np.ndarray) -> np.ndarray:
    found, corners = cv2.findChessboardCorners(image, INNER)
    assert found
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    return cv2.cornerSubPix(image, corners, (7, 7), (-1, -1), criteria).reshape(-1, 2)


def test_sigma_is_that_of_the_errors_on_boards(boards):
    """The squares have no texture: what is measured lies beside their edges, and two fifths are off by over a pixel.

    All of it counts: errors that were picked for being small say nothing about sigmas as large.
    """
    rig, views = boards
    errors, sigmas = [], []
    for images, (left, right) in views:
        disparity = left[:, 0] - right[:, 0]
        plane = np.linalg.lstsq(np.c_[left, np.ones(len(left))], disparity, rcond=None)[0]
        v, u = np.mgrid[: SIZE[1], : SIZE[0]]
        inside = cv2.fillConvexPoly(np.zeros(SIZE[::-1], np.uint8), cv2.convexHull(left.round().astype(np.int32)), 1)
        inside = torch.from_numpy(cv2.erode(inside, np.ones((9, 9)))) > 0
        z = [
            focal_length_px(rig) * rig.baseline_mm / (end + rig.principal_right_px - rig.principal_left_px)
            for end in (disparity.min() - 15, disparity.max() + 15)
        ]
        heights = tuple(float(zero_disparity_mm(rig) - value) for value in z)
        match = measure_strip(
            *(torch.from_numpy(image)[..., None] for image in images), rig, DisparityConfig(height_range_mm=heights)
        )
        error = match.disparity - torch.from_numpy(plane[0] * u + plane[1] * v + plane[2])
        errors.append(error[inside])
        sigmas.append(match.sigma[inside])
    ratio = (torch.cat(errors) / torch.cat(sigmas)).abs()
    ratio = ratio[ratio.isfinite()]
    assert 0.8 < ratio.median() / 0.6745 < 1.3
    assert 0.8 < ratio[ratio <= 5].square().mean().sqrt() < 1.3
    assert (ratio > 5).float().mean() < 0.005
