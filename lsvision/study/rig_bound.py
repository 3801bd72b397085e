"""The least errors that any calibration of simulated raw rigs can have.

Source: Van Trees 1968, Detection, Estimation, and Modulation Theory I, sec. 2.4: the Cramér-Rao bound of unknowns
that are drawn from a known distribution.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState, shared_information
from lsvision.stages.rig.model import POSE, RigModel, RigPrior
from lsvision.stages.rig.solve import corner_residuals
from lsvision.study.rig_scans import RigScans


def least_factor(
    scans: RigScans, prior: RigPrior, drawn_sigma: Float[Tensor, " shared"]
) -> Float[Tensor, "runs shared shared"]:
    """Factors of the least covariances of rig and motion, in sigmas of the prior, one of each run.

    Args:
        drawn_sigma: standard deviations of the true rigs and motions, in sigmas of the prior.
    """
    runs, boards = scans.sightings.valid.shape[:2]
    points = scans.sightings.board_points
    body = (points - points.mean(0)).expand(runs, boards, -1, 3)
    shared = prior.state(scans.truth)
    model = RigModel(prior, scans.poses, shared.new_zeros(runs, boards), body)

    def residual(state: BorderedState) -> Tensor:
        return corner_residuals(model, scans.sightings, state).flatten(-2)

    truth = BorderedState(shared, shared.new_zeros(runs, boards, POSE))
    information = shared_information(residual, truth).sum(-3)
    eye = torch.eye(len(drawn_sigma), dtype=shared.dtype)
    in_drawn = torch.linalg.inv(drawn_sigma[:, None] * information * drawn_sigma + eye)
    return drawn_sigma[:, None] * torch.linalg.cholesky(in_drawn)
