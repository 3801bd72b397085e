"""One joint calibration of three boards of 88 corners, compared with scipy's least squares on the same residuals.

Ours also computes the covariance, the consistency of the residuals, the observed directions and the next tilt.
"""

import math
import time
from functools import partial

import torch
from scipy.optimize import least_squares

from lsvision.geometry import rotation_from_vector, scan_position, transform
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.model import whitened_residuals
from lsvision.stages.calibration.problem import nominal_problem
from lsvision.types import Board, BoardCorners, Rig

RIG = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375)
TILTS = ((10.0, 0.0, 2.0), (-10.0, 5.0, 1.0), (3.0, -10.0, 0.0))
MOTION, SIGMA = (0.0357, 1.0236, 0.0268), (0.020, 0.020, 0.014)
TURNS = 20


def boards() -> list[BoardCorners]:
    """Corners of a GP400-12-9 board at three tilts, with noise."""
    body = Board(12, 9, 30.0).corner_points()
    sigma = torch.tensor(SIGMA, dtype=torch.float64)
    rotation = rotation_from_vector(torch.tensor(TILTS, dtype=torch.float64).deg2rad())
    moved = transform(rotation, torch.tensor([[20.0, 60.0, 800.0]], dtype=torch.float64), body)
    measured = scan_position(moved, torch.tensor(MOTION, dtype=torch.float64))
    noise = torch.randn(measured.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    covariance, valid = torch.diag(sigma**2).expand(88, 3, 3), torch.ones(88, dtype=torch.bool)
    return [
        BoardCorners(f"board {i}", points, covariance, valid, body, points[:, :2])
        for i, points in enumerate(measured + sigma * noise)
    ]


def run() -> dict[str, object]:
    """Milliseconds per calibration of both, the best of alternating turns, and their difference in n."""
    torch.set_num_threads(1)
    corners = boards()
    points, covariance, body, valid = (
        torch.stack([getattr(board, name) for board in corners])
        for name in ("points", "covariance", "board_points", "valid")
    )
    problem, start = nominal_problem(points, torch.linalg.cholesky(covariance), body, valid)
    residual = partial(whitened_residuals, problem)
    ours = peer = math.inf
    for _ in range(TURNS):
        begin = time.perf_counter()
        calibration = calibrate(corners, RIG, CalibrationConfig())
        middle = time.perf_counter()
        solution = least_squares(lambda x: residual(torch.from_numpy(x)).numpy(), start.numpy(), x_scale="jac")
        ours, peer = min(ours, middle - begin), min(peer, time.perf_counter() - middle)
    difference = (calibration.motion.n - torch.from_numpy(solution.x[-3:])).abs() / calibration.motion.sigma
    return {
        "unit": "milliseconds per calibration",
        "lsvision": round(ours * 1e3, 2),
        "scipy": round(peer * 1e3, 2),
        "ratio": round(peer / ours, 2),
        "difference_in_sigmas": float(difference.max()),
    }
