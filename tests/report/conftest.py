"""A determined calibration, one that repeats its prior, and the corners of a board."""

import dataclasses

import pytest
import torch

from lsvision.types import (
    Board,
    BoardCorners,
    BoardFit,
    Calibration,
    Iteration,
    Motion,
    Observability,
    ObservedDirection,
    Pose,
    Rig,
)


def direction(index: int, posterior_sigma: float, observed: bool) -> ObservedDirection:
    vector = [0.0, 0.0, 0.0]
    vector[index] = 1.0
    return ObservedDirection(tuple(vector), 0.05, posterior_sigma, observed)


@pytest.fixture
def corners() -> BoardCorners:
    points = Board(4, 4, 30.0).corner_points()
    measured = points @ torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    measured = measured * torch.tensor([1.0, 1 / 1.02, 1.0], dtype=torch.float64)
    measured = measured + torch.tensor([200.0, 0.0, 797.0], dtype=torch.float64)
    return BoardCorners(
        scan="scans/<first> & last",
        points=measured,
        covariance=1e-4 * torch.eye(3, dtype=torch.float64).expand(9, 3, 3),
        valid=torch.ones(9, dtype=torch.bool),
        board_points=points,
        left_px=measured[:, :2],
    )


@pytest.fixture
def determined() -> Calibration:
    n = torch.tensor([-0.026, 1.02, 0.014], dtype=torch.float64)
    observed = tuple(direction(k, 2e-5 * (k + 1), True) for k in range(3))
    fit = BoardFit("scans/<first> & last", 9, Pose(torch.eye(3).double(), torch.zeros(3).double()), 2.0, 0.5)
    return Calibration(
        method="joint",
        motion=Motion(n, torch.diag(torch.tensor([2e-5, 4e-5, 6e-5], dtype=torch.float64) ** 2)),
        rmse_before_mm=2.0,
        rmse_after_mm=0.5,
        iterations=(Iteration(2.0, (0.0, 1.0, 0.0), 1.0), Iteration(0.5, (-0.026, 1.02, 0.014), 1.0204)),
        boards=(fit, dataclasses.replace(fit, scan="scans/second")),
        observability=Observability(observed, "n is determined"),
        rig=Rig(447, 160.0, 113.84, 354.0, 64.6, 380.7),
    )


@pytest.fixture
def dominated(determined: Calibration) -> Calibration:
    seen = (direction(0, 2e-5, True), direction(2, 0.049, False))
    advice = "the boards do not show n3: tilt the board by 15 deg"
    return dataclasses.replace(
        determined,
        method="two_step",
        observability=Observability(seen, advice),
        verdict="not converged",
        reasons=("the estimate had not settled after 20 iterations", advice),
        converged=False,
    )
