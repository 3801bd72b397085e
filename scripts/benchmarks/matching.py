"""Disparity of full-size strips: coarse to fine, compared with one pass of OpenCV's StereoSGBM over 336 disparities.

Both match the same rendered pairs, 7142 x 1024 px in colour with noise 2 of 255, on one thread; OpenCV in its mode
3WAY. Errors are differences from the renderer's truth. Pixels with an error of more than 1 px count as wrong; the rms
error is that of the others.
"""

import math
import time
from dataclasses import dataclass

import cv2
import torch
from torch import Tensor

from lsvision.geometry import project
from lsvision.image.tiling import keep_freed_memory
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import StripMatch, measure_strip
from lsvision.types import Board, Rig

RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
LINES, TURNS = 1024, 3
OURS = DisparityConfig(matcher="coarse_to_fine", largest_sigma_px=0.2)
LOWEST, COUNT = -168, 336  # of the peer's range, px
SCENES = {
    "rail": SceneConfig("rail", texture_mm=0.15),
    "sheet": SceneConfig("sheet", texture_mm=0.15, pitch_deg=1.5, roll_deg=-1.0, yaw_deg=3.0),
}


@dataclass(frozen=True)
class Pair:
    """Images ``(lines, width, 3)`` of both cameras and the true disparity ``(lines, width)`` of the left one, px."""

    left: Tensor
    right: Tensor
    disparity: Tensor


def run() -> dict[str, object]:
    """Throughput and errors of both on each scene; ``ratio`` is that of the rail in the best turn of each."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()
    scenes = {name: _compare(scene) for name, scene in SCENES.items()}
    return {"ratio": scenes["rail"]["ratio"], "scenes": scenes}


def _compare(scene: SceneConfig) -> dict[str, object]:
    pair = _rendered(scene)
    seconds = {"lsvision": math.inf, "opencv": math.inf}
    figures: dict[str, object] = {}
    for _ in range(TURNS):
        for name, matched in (("lsvision", _ours), ("opencv", _peer)):
            begin = time.perf_counter()
            match = matched(pair.left, pair.right)
            seconds[name] = min(seconds[name], time.perf_counter() - begin)
            figures[name] = _errors(match, pair.disparity)
    megapixels = pair.disparity.numel() / 1e6
    throughput = {name: round(megapixels / value, 2) for name, value in seconds.items()}
    return {"ratio": round(seconds["opencv"] / seconds["lsvision"], 2), "megapixels_per_second": throughput} | figures


def _ours(left: Tensor, right: Tensor) -> StripMatch:
    return measure_strip(left, right, RIG, OURS)


def _peer(left: Tensor, right: Tensor) -> StripMatch:
    """OpenCV alone, with the paper's settings."""
    grey = (cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY) for image in (left, right))
    matcher = cv2.StereoSGBM.create(
        minDisparity=LOWEST, numDisparities=COUNT, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=10,
        uniquenessRatio=5, speckleWindowSize=100, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = torch.from_numpy(matcher.compute(*grey)).float() / 16
    disparity = torch.where(disparity >= LOWEST, disparity, torch.nan)
    return StripMatch(disparity, torch.full_like(disparity, torch.nan))


def _rendered(scene: SceneConfig) -> Pair:
    """A rendered pair of a scene in motion."""
    motion = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
    sensor = SensorConfig(noise=2.0, supersampling=2)
    source = simulate(RIG, Board(12, 9, 30.0), scene, motion, sensor, Acquisition(0.07, lines=LINES))
    left, right = (torch.cat(list(source.strips(camera))) for camera in ("left", "right"))
    depth = torch.cat(list(source.depth_strips())).double()
    left_px, right_px = project(RIG, torch.zeros_like(depth), depth)
    return Pair(left, right, (left_px - right_px).float())


def _errors(match: StripMatch, truth: Tensor) -> dict[str, float]:
    error = match.disparity - truth
    known, close = torch.isfinite(error), error.abs() <= 1.0
    within, sigma = error[close], match.sigma[close]
    figures = {
        "density": float(known.float().mean()),
        "wrong": float((known & ~close).float().mean()),
        "rms_px": float(within.square().mean().sqrt()),
        "bias_px": float(within.mean()),
        # The median of |error| / sigma is 0.6745 where sigma is right.
        "actual_over_predicted_sigma": float((within.abs() / sigma).median()) / 0.6745,
    }
    return {key: round(value, 5) for key, value in figures.items() if math.isfinite(value)}
