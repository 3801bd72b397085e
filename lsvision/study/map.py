"""How well a flat board and a second one would determine n, by the tilt of the second: which boards to scan."""

from dataclasses import replace

import torch

from lsvision.estimation import cramer_rao_bound
from lsvision.report import TiltMap
from lsvision.simulation import BoardPose
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.observability import simulated_information
from lsvision.study.points import Conditions, exact_corners, noise_chol, true_problem
from lsvision.types import Board, Rig


def tilt_map(rig: Rig, board: Board, conditions: Conditions, range_deg: float, steps: int) -> TiltMap:
    """Bound on the sigma of n along its weakest direction, from a flat board and a second one, over a grid of tilts.

    No calibrations are run: it is the Cramér-Rao bound, the prior included.

    Args:
        conditions: noise, motion and prior; their boards are not used.
        range_deg: largest tilt of the second board about X and about Y, deg, to either side.
        steps: tilts about each axis.
    """
    placed = replace(conditions, boards="flat")
    corners = exact_corners(rig, board, {"flat": [BoardPose(0.0, 0.0, 0.0)]}, placed)
    problem, state = true_problem(corners, noise_chol(conditions))
    tilts = torch.linspace(-range_deg, range_deg, steps, dtype=torch.float64)
    second = simulated_information(problem, state, torch.cartesian_prod(tilts, tilts))
    prior = torch.eye(3, dtype=torch.float64) / conditions.prior_sigma**2
    bound = cramer_rao_bound(motion_information(problem, state) + second, prior)
    worst = torch.linalg.eigvalsh(bound)[:, -1].sqrt()
    return TiltMap(tilts, worst.reshape(steps, steps), conditions.prior_sigma)
