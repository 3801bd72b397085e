"""Calibrations of three boards of 88 corners: a study's batches, compared with a loop over scipy's least_squares.

Both start from the best fits of the boards under the nominal motion, estimate the same 21 unknowns from the same noisy
corners under the same prior, and return n with its covariance. The study runs on two threads, its default; the loop
runs on one. scipy has a residual vectorised in numpy and its default settings: trust region, finite differences.
"""

import statistics
import time

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lsvision.experiments.command import config_folder
from lsvision.experiments.settings import build_settings
from lsvision.experiments.study import StudySettings
from lsvision.study.points import exact_corners, noise_chol
from lsvision.study.runs import Sampling, noisy_points, run_points

RUNS, PEER_RUNS, TURNS, THREADS = 2048, 96, 7, 2


class Peer:
    """Calibrations one after the other by scipy."""

    def __init__(self, settings: StudySettings) -> None:
        self.point = settings.conditions
        self.corners = exact_corners(settings.rig, settings.board, settings.placings, self.point)
        body = self.corners.board_points[0]
        self.body = (body - body.mean(0)).numpy()
        self.sigma = noise_chol(self.point).diagonal().numpy()

    def calibrate(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """n of one calibration and its covariance."""
        middle = measured.mean(1)
        u, _, vh = np.linalg.svd((measured - middle[:, None]).transpose(0, 2, 1) @ self.body)
        sign = np.stack([np.ones(len(u)), np.ones(len(u)), np.linalg.det(u @ vh)], axis=-1)
        nominal = (u * sign[:, None]) @ vh
        start = np.concatenate([np.concatenate([np.zeros_like(middle), middle], axis=1).ravel(), [0.0, 1.0, 0.0]])

        def residual(state: np.ndarray) -> np.ndarray:
            poses, n = state[:-3].reshape(-1, 6), state[-3:]
            rotation = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ nominal
            placed = self.body @ rotation.transpose(0, 2, 1) + poses[:, None, 3:]
            travel = placed[..., 1:2] / n[1]
            predicted = placed - travel * n
            predicted[..., 1:2] = travel
            from_prior = (n - [0.0, 1.0, 0.0]) / self.point.prior_sigma
            return np.concatenate([((measured - predicted) / self.sigma).ravel(), from_prior])

        solution = least_squares(residual, start)
        return solution.x[-3:], np.linalg.inv(solution.jac.T @ solution.jac)[-3:, -3:]


def run() -> dict[str, object]:
    """Calibrations per second of both in alternating turns; ``ratio`` is the median over the turns."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        values = OmegaConf.to_container(compose("config", ["+experiment=study_tilts"]), resolve=True)
    settings = build_settings(StudySettings, values)
    peer = Peer(settings)
    measured = noisy_points(peer.corners, peer.point, 0, 0, PEER_RUNS).numpy()
    torch.set_num_threads(1)
    sampling = Sampling(RUNS, settings.batch, seed=0, threads=THREADS)
    ours, theirs, difference = [], [], 0.0
    for _ in range(TURNS):
        begin = time.perf_counter()
        (found,) = run_points([peer.point], [peer.corners], settings.calibration, sampling)
        ours.append(RUNS / (time.perf_counter() - begin))
        begin = time.perf_counter()
        n = np.stack([peer.calibrate(points)[0] for points in measured])
        theirs.append(PEER_RUNS / (time.perf_counter() - begin))
        error = np.abs(found.n[:PEER_RUNS].numpy() - n) / found.covariance[0].diagonal().sqrt().numpy()
        difference = max(difference, float(error.max()))
    return {
        "unit": "calibrations of 3 x 88 corners per second",
        "lsvision": round(statistics.median(ours), 1),
        "scipy": round(statistics.median(theirs), 1),
        "ratio": round(statistics.median(a / b for a, b in zip(ours, theirs, strict=True)), 1),
        "seconds_for_10000": round(10_000 / statistics.median(ours), 1),
        "threads": THREADS,
        "largest_difference_in_sigmas": difference,
    }
