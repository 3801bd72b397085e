"""The least errors that any calibration of simulated raw rigs can have.

A calibration weighs the corners against the data sheet, which draws every single rig towards it: for one given rig it
is biased, and the bound of unbiased estimates does not hold. Over rigs drawn from a distribution, the least mean square
error of any estimate is the mean of the posterior's covariance. To first order in the noise that is the mean of
``(information of the corners of a rig + information of the draw)^-1`` over the rigs. A calibration reaches it if its
prior is what the rigs are drawn from: with a wider one, its errors are larger by what it does not know of them, however
well it computes.

With the mean of the information in place of the mean of its inverse it would be the bound of van Trees, which holds
for any noise. It is a third of this one, and nothing reaches it: the combination of quantities that is known least is
another for every rig, and their mean information knows all of them.

The poses are given, and unknown to the calibration: a flat prior of them adds no information.

Source: Van Trees 1968, Detection, Estimation, and Modulation Theory I, sec. 2.4; Van Trees & Bell 2007, Bayesian Bounds
for Parameter Estimation and Nonlinear Filtering/Tracking, sec. 1 (the expected Cramér-Rao bound beside it); Rockah &
Schultheiss 1987, IEEE Trans. ASSP 35(3):286-299 (drawn and given unknowns together).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState, shared_information
from lsvision.stages.rig.model import POSE, RigModel, RigPrior
from lsvision.stages.rig.solve import corner_residuals
from lsvision.study.rig_scans import RigScans


def information_of_corners(scans: RigScans, drawn: RigPrior) -> Float[Tensor, "runs shared shared"]:
    """Information of the corners of each run on rig and motion in units of what they are drawn from, poses unknown."""
    runs, boards = scans.sightings.valid.shape[:2]
    points = scans.sightings.board_points
    body = (points - points.mean(0)).expand(runs, boards, -1, 3)
    shared = scans.state
    model = RigModel(drawn, scans.poses, shared.new_zeros(runs, boards), body)

    def residual(state: BorderedState) -> Tensor:
        return corner_residuals(model, scans.sightings, state).flatten(-2)

    truth = BorderedState(shared, shared.new_zeros(runs, boards, POSE))
    return shared_information(residual, truth).sum(-3)


def least_factor(information: Float[Tensor, "*runs shared shared"], off: float) -> Float[Tensor, "*runs shared shared"]:
    """Factor of the least covariance of rig and motion of each run, in units of what they are drawn from.

    Args:
        information: of the corners of each run. off: what the deviations were multiplied by.
    """
    eye = torch.eye(information.shape[-1], dtype=information.dtype)
    return off * torch.linalg.cholesky(torch.linalg.inv(off**2 * information + eye))
