"""Covariance of corners in the images of a second separate renderer, whose cameras are turned and distorted."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lsvision.image.board.detect import detect_board
from lsvision.types import Board, TensorImage

BOARD = Board(12, 9, 30.0)
BASELINE_MM, PITCH_MM, NOMINAL_TURN_DEG = 354.0, 0.56, 12.522717353796438


def true_pixels(folder: Path, side: str) -> torch.Tensor:
    """Where a raw camera of the data's description sees the corners of a board that moves straight."""
    truth = json.loads((folder / "truth.json").read_text())
    camera, n = truth[side], truth["n"]
    x0, y0, z0 = (BOARD.corner_points().numpy() @ np.array(truth["R"]).T + truth["T"]).T
    zero = BASELINE_MM / 2 / math.tan(math.radians(NOMINAL_TURN_DEG))
    travel = y0 / n[1]
    for _ in range(20):  # the line in which the camera's own plane meets the corner
        x, z = x0 - travel * n[0], z0 - travel * n[2]
        plane = camera["s0"] + camera["s1"] * (x - BASELINE_MM / 2) + camera["s2"] * (z - zero)
        travel = (y0 - plane) / n[1]
    bent = np.tan(np.arctan((x - BASELINE_MM * (side == "right")) / z) - camera["turn"])
    straight = bent
    for _ in range(20):
        straight = bent / (1 + camera["k1"] * straight**2 + camera["k2"] * straight**4)
    return torch.from_numpy(np.stack([camera["c"] + camera["f_px"] * straight, travel / PITCH_MM], -1))


@pytest.mark.slow
def test_chi_square_of_corners_of_raw_cameras(shared_data: Path):
    means = []
    for name, side in ((name, side) for name in "abcdefgh" for side in ("left", "right")):
        folder = shared_data / "scans_shaken_and_raw" / f"raw_{name}"
        image = torch.from_numpy(cv2.imread(str(folder / f"{side}.tif"))[..., ::-1].copy())
        found = detect_board(TensorImage(image), BOARD)
        assert found is not None
        assert found.valid.sum() >= 87
        error = (found.position - true_pixels(folder, side))[found.valid]
        assert error.abs().max() < 0.1
        covariance = found.covariance[found.valid]
        means.append(float((error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1).mean()))
    # The mean over the 16 images; a single board has 88 corners (2 ± 0.21) and one texture.
    assert 1.8 < np.mean(means) < 2.2
    assert min(means) > 1.2
    assert max(means) < 2.8
