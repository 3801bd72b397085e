"""The spread of a posterior along the turn that boards hardly show, where no tangent holds.

A turn ψ of all boards about the scan line, and the change of n that goes with it, look alike: the states that fit lie
on a curve, which over the prior's range departs from its tangent by thousands of sigmas. (In the plane of n2 and n3 it
is a circle, about the n3 that would make one flat board appear as it does.) Given ψ, all else is known so well that the
model is linear. So the posterior is a mixture over ψ of Gaussians about the most likely states given ψ, and its second
moment needs no linearisation along the curve. Each is weighed by its likelihood and prior alone: the volume that is
left to the poses would prefer a large n2, as their flat prior is one at travel zero, and is no knowledge of ψ.

Source: Rue, Martino & Chopin 2009 (nested approximation); Golub & Welsch 1969 (nodes and weights).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import apply, lower_factor
from lsvision.stages.calibration.mode import FurtherRows, Mode, find_mode, step_from
from lsvision.stages.calibration.problem import BoardProblem, BoardState

# Nodes over ψ. Under a prior of 0.05 five give the sigmas of nine in every direction to a hundredth.
_FEW_NODES, _NODES, _WIDE_PRIOR = 5, 7, 0.05
# Sigma of ψ, rad, that holds a node in its place: far below what any scan shows of it.
_HELD = 1e-7
# The largest distance of a node, rad: at a right angle the object would not move along the scan any more.
_FARTHEST = 1.3
_NODE_ITERATIONS, _NODE_DISTANCE = 6, 0.05  # a node's last step may be this long, in sigmas
_LOST_SHARE = 1e-3  # of the probability, that may lie at nodes that were not found

# A curve whose sagitta over the posterior is below this many sigmas of all corners together is its tangent.
_STRAIGHT = 0.3


@dataclass(frozen=True)
class Spread:
    """Lower triangular factor of the second moment of a posterior about its mode, and whether its nodes were found."""

    factor: Float[Tensor, "*batch state state"]
    found: Bool[Tensor, "*batch"]


@dataclass(frozen=True)
class _Nodes:
    """Values of ψ at which states are looked for, ``(nodes, *batch)``, where they start, and the log of the weights."""

    turn: Tensor
    start: Tensor
    log_weight: Tensor


def is_curved(problem: BoardProblem, factor: Float[Tensor, "*batch state columns"]) -> Bool[Tensor, "*batch"]:
    """Whether a posterior is too wide in the boards' rotations for one linearisation.

    The second-order change of a rotation by an angle of variance v is v in the mean; whitened by the corners' noise it
    is at most the norm of their rows on the rotation times v.
    """
    theta = factor[..., :-3, :].unflatten(-2, (problem.boards, 6))[..., :3, :]
    by_rotation = torch.linalg.matrix_norm(problem.affine_rows[..., 3:12])
    return (by_rotation * theta.square().sum((-2, -1))).sum(-1) > _STRAIGHT


def spread_along_turn(problem: BoardProblem, further: FurtherRows, mode: Mode, prior_sigma: float) -> Spread:
    """The second moment about the mode of the posterior over all turns that the boards leave open.

    Args:
        further: rows of the prior, as ``find_mode`` had them.
        prior_sigma: of each component of n.
    """
    nodes = _nodes(mode, _FEW_NODES if prior_sigma <= _WIDE_PRIOR else _NODES)

    def rows(state: Tensor) -> Tensor:
        """The prior, and ψ held at its node."""
        constraint = torch.cat([turn_gradient(state), (nodes.turn - turn(state))[..., None]], dim=-1) / _HELD
        return torch.cat([further(state), constraint[..., None, :]], dim=-2)

    found = find_mode(problem, rows, nodes.start, _NODE_ITERATIONS, _NODE_DISTANCE)
    log_weight = nodes.log_weight - found.here.cost / 2
    share = _shares(torch.where(torch.isfinite(log_weight), log_weight, -torch.inf))
    lost = torch.where(found.converged, 0.0, share).movedim(0, -1).contiguous().sum(-1)
    columns = torch.cat([found.here.factor, (found.state - mode.state)[..., None]], dim=-1)
    columns = torch.where((share > 0)[..., None, None], share.sqrt()[..., None, None] * columns, 0.0)
    factor = lower_factor(columns.movedim(0, -2).flatten(-2))
    return Spread(factor, mode.converged & (lost < _LOST_SHARE))


def _shares(log_weight: Tensor) -> Tensor:
    """Weights over the first dimension that sum to one; the nodes come last in the sum, whose order is then fixed."""
    weight = (log_weight - log_weight.amax(0)).exp()
    return weight / weight.movedim(0, -1).contiguous().sum(-1)


def turn(state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch"]:
    """ψ, rad: the boards' mean rotation about the scan line, from their nominal ones."""
    return BoardState.split(state).theta[..., 0].mean(-1)


def turn_gradient(state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state"]:
    """Derivative of ψ by the state."""
    parts = BoardState.split(torch.zeros_like(state))
    theta = parts.theta.clone()
    theta[..., 0] = 1 / theta.shape[-2]
    return BoardState(theta, parts.position, parts.n).join()


def _nodes(mode: Mode, count: int) -> _Nodes:
    """Nodes of Gauss-Hermite quadrature about the mode, as wide as its tangent says, on the tangent."""
    points, weights = (mode.state.new_tensor(values) for values in np.polynomial.hermite_e.hermegauss(count))
    factor = mode.here.factor
    along = apply(factor.mT.contiguous(), turn_gradient(mode.state))
    sigma = torch.linalg.vector_norm(along, dim=-1)
    tangent = apply(factor, along) / sigma[..., None].square()  # change of the state by ψ
    by_node = (-1, *(1,) * sigma.ndim)
    offset = sigma.clamp(max=_FARTHEST / float(points.max())) * points.reshape(by_node)
    log_weight = weights.log().reshape(by_node) + points.square().reshape(by_node) / 2
    return _Nodes(turn(mode.state) + offset, step_from(mode.state, offset[..., None] * tangent), log_weight)
