"""Errors of the motion from line to line of shaken rails, matched and registered, in units of their covariance.

``nees`` is the mean square of (δx, δz, ρ), 3 where the covariance is right, over lines that are as far apart as errors
last; ``independent`` is how many those are, and ``band`` holds such a mean 95 times in a hundred. ``ratio`` is how far
inside of ``ASKED`` it lies. Rails are a quarter of the camera's size; ``--full`` takes one of the whole.
"""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from line_motion import FULL_RIG, MOTION, PITCH_MM
from torch import Tensor

from lsvision.archive.line_motion import DepthAlone
from lsvision.estimation import mean_chi_square_band
from lsvision.geometry import scaled_rig, without_trend
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.measure import measure_line_motion
from lsvision.types import Board, Motion, Scan, StereoPair, TensorImage

SEEDS, ASKED = 4, (2.5, 3.6)
_FORGOTTEN = 0.05  # correlation of errors that counts as none


def whitened_errors(scale: int, lines: int, seed: int) -> Tensor:
    """Errors ``(lines, 3)`` of a rail's motion in units of their covariance."""
    rail = simulate(
        scaled_rig(FULL_RIG, scale),
        Board(12, 9, 30.0),
        SceneConfig("rail", seed=seed),
        replace(MOTION, seed=seed),
        SensorConfig(supersampling=1, seed=seed),
        Acquisition(PITCH_MM * scale, lines=lines),
    )
    left, right = (TensorImage(torch.cat(list(rail.strips(camera)))) for camera in ("left", "right"))
    scan = Scan(Path("rail"), rail.rig, rail.travel, StereoPair(left, right), True)
    n = Motion(rail.trajectory.n, torch.zeros(3, 3, dtype=torch.float64))
    depth = DepthAlone(depth_of(scan, DisparityConfig()))
    found = measure_line_motion(scan, depth, n, LineMotionConfig()).motion
    at = torch.arange(lines).double()
    error = found.values[:, :3] - without_trend(at)(rail.trajectory.vibration(at).T).T
    root = torch.linalg.cholesky(found.covariance[:, :3, :3])
    return torch.linalg.solve_triangular(root, error[..., None], upper=False)[..., 0]


def lasting(errors: Tensor) -> int:
    """Lines over which errors last: the variance of a mean over that of as many independent ones."""
    power = torch.fft.rfft(errors - errors.mean(0), n=2 * len(errors), dim=0).abs().square()
    sums = torch.fft.irfft(power, dim=0)[: len(errors) // 2].sum(1)
    correlation = sums / sums[0]
    return math.ceil(float(1 + 2 * (correlation[1:] * (correlation[1:] > _FORGOTTEN).cumprod(0)).sum()))


def run(*, full: bool = False) -> dict[str, object]:
    """The mean square over all rails, and that of each."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    scale, lines, seeds = (1, 4096, 1) if full else (4, 1024, SEEDS)
    means, counts = [], []
    for seed in range(seeds):
        errors = whitened_errors(scale, lines, seed)
        thinned = errors[:: lasting(errors)]
        means.append(float(thinned.square().sum(-1).mean()))
        counts.append(len(thinned))
    independent = sum(counts)
    nees = sum(mean * count for mean, count in zip(means, counts, strict=True)) / independent
    return {
        "unit": "mean normalised squared error of three components, on lines that err independently",
        "nees": round(nees, 2),
        "by_seed": [round(mean, 2) for mean in means],
        "independent": independent,
        "band": [round(bound, 2) for bound in mean_chi_square_band(3, independent)],
        "ratio": round(min(nees / ASKED[0], ASKED[1] / nees), 3),
    }
