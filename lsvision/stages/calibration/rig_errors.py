"""What is not known of the rig, in the covariance of n: the same errors of the rig in all scans.

The state follows the corners' points by one Gauss-Newton step about the posterior, which is exact to first order. The
step is that of corners whose noise is independent, also where errors along the scan were found.

Source: Bierman 1977, Factorization Methods for Discrete Sequential Estimation, ch. VII (consider parameters).
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.mode import gauss_newton_step, rows_of
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.solved import Solution
from lsvision.types import BoardCorners

_WORTH_A_NOTE = 1.05  # ratio of the sigmas with and without the rig's


def motion_by_rig(
    boards: Sequence[BoardCorners], solution: Solution, config: CalibrationConfig
) -> Float[Tensor, "3 modes"] | None:
    """How far n is off by each of the rig's independent errors, of one sigma; None where the rig counts as exact."""
    by_board = [board.by_rig for board in boards]
    known = [by_rig for by_rig in by_board if by_rig is not None]
    if len(known) < len(boards):
        return None
    problem = replace(solution.problem.scaled(solution.noise_scale), correlated=None)
    shape = problem.valid.shape[-1]
    off = torch.stack([torch.cat([one, one.new_zeros(shape - len(one), *one.shape[1:])]) for one in known])
    off = torch.where(problem.valid[..., None, None], off, 0.0).movedim(-1, 0)
    modes = len(off)
    points = torch.cat([problem.points[None], problem.points + off])
    repeated = {
        name: value.expand(modes + 1, *value.shape)
        for name in ("noise_chol", "body_points", "centroid", "valid", "rotation")
        if (value := getattr(problem, name)) is not None
    }
    state = solution.posterior.mean.expand(modes + 1, -1)
    prior = prior_about(solution.start, config)
    step = gauss_newton_step(replace(problem, points=points, **repeated), rows_of(prior), state).step[:, -3:]
    return (step[1:] - step[0]).mT


def widened_by_rig(
    covariance: Float[Tensor, "3 3"], by_rig: Float[Tensor, "3 modes"] | None
) -> tuple[Float[Tensor, "3 3"], tuple[str, ...]]:
    """The covariance of n with the rig's errors, and the sentence that says what they do to its sigmas."""
    if by_rig is None:
        return covariance, ()
    wide = covariance + by_rig @ by_rig.mT
    before, after = (matrix.diagonal().sqrt() for matrix in (covariance, wide))
    if not bool((after > _WORTH_A_NOTE * before).any()):
        return wide, ()
    words = (", ".join(f"{value:.1e}" for value in sigma.tolist()) for sigma in (before, after))
    return wide, (f"what is not known of the rig brings the sigmas of n from {next(words)} to {next(words)}",)
