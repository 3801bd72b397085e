"""Corners of a full-size board, compared with OpenCV's findChessboardCornersSB on the same image, one thread.

The image is rendered: 7142 px wide, noise 3 of 255, blur 1 px, sheared and stretched as a moving board is. Errors are
differences from the renderer's truth.
"""

import math
import time

import cv2
import torch
from torch import Tensor

from lsvision.image.board.detect import detect_board
from lsvision.image.board.order import order_grid
from lsvision.image.brightness import gray
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.types import Board, Rig, TensorImage

RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
BOARD = Board(12, 9, 30.0)
TURNS = 3


def run() -> dict[str, object]:
    """Processor seconds and errors of both; ``ratio`` is OpenCV's time over ours in the best turn of each.

    What else the machine does at the time hardly changes them.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    image, truth = _rendered()
    ours = peer = math.inf
    for _ in range(TURNS):
        begin = time.process_time()
        found = detect_board(TensorImage(image), BOARD)
        ours = min(ours, time.process_time() - begin)
        begin = time.process_time()
        corners = _peer(image)
        peer = min(peer, time.process_time() - begin)
    if found is None or corners is None:
        raise RuntimeError("no board found in the rendered image")
    grid = order_grid(corners.reshape(BOARD.inner[1], BOARD.inner[0], 2), gray(image))
    sigma = found.covariance[found.valid].diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    return {
        "image": list(image.shape),
        "processor_seconds": {"lsvision": round(ours, 3), "opencv": round(peer, 3)},
        "ratio": round(peer / ours, 1),
        "corners": int(found.valid.sum()),
        "lsvision": _errors((found.position - truth)[found.valid]) | {"predicted_sigma_px": _rounded(sigma)},
        "opencv": _errors(grid.reshape(-1, 2) - truth),
    }


def _rendered() -> tuple[Tensor, Tensor]:
    scene = SceneConfig("board", pitch_deg=2.0, roll_deg=1.5, yaw_deg=8.0, texture_mm=0.15, board_texture=0.0)
    motion = MotionConfig(angle_x_deg=3.0, stretch=1.0246)
    sensor = SensorConfig(noise=3.0, blur_px=1.0, supersampling=2)
    source = simulate(RIG, BOARD, scene, motion, sensor, Acquisition(0.07))
    return torch.cat(list(source.strips("left"))), source.corners()[0]


def _peer(image: Tensor) -> Tensor | None:
    grey = cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCornersSB(grey, BOARD.inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return torch.from_numpy(corners).reshape(-1, 2).double() if found else None


def _errors(error: Tensor) -> dict[str, list[float]]:
    return {"rms_px": _rounded(error.square().mean(0).sqrt()), "bias_px": _rounded(error.mean(0))}


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 5) for value in values.tolist()]
