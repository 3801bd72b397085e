"""The spread of a posterior along the turn that boards hardly show, where no tangent holds.

A turn of all boards about the scan line and the same turn of n, φ = atan(n3 / n2), look alike: the states that fit lie
on a curve, which over the prior's range of φ departs from its tangent by thousands of sigmas. Given φ, all else is
known so well that the model is linear. So the posterior is a mixture over φ of Gaussians about the most likely states
given φ, each weighed by its probability, and its second moment needs no linearisation along the curve.

Source: Rue, Martino & Chopin 2009 (nested Laplace approximation); Golub & Welsch 1969 (nodes and weights).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import apply, lower_factor
from lsvision.stages.calibration.mode import FurtherRows, Mode, find_mode, step_from
from lsvision.stages.calibration.problem import BoardProblem, BoardState

# Nodes over φ: exact for a mixture whose moments are polynomials of degree 13 in φ. With five, one of 600 sets under a
# prior of 0.3 had a wrong covariance; seven and nine agree to a hundredth.
_NODES = 7
# Sigma of φ, rad, that holds a node in its place: far below what any scan shows of it.
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
    """Values of φ at which states are looked for, ``(nodes, *batch)``, where they start, and the log of the weights."""

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


def spread_along_turn(problem: BoardProblem, further: FurtherRows, mode: Mode) -> Spread:
    """The second moment about the mode of the posterior over all turns that the boards leave open.

    Args:
        further: rows of the prior, as ``find_mode`` had them.
    """
    nodes = _nodes(mode)

    def rows(state: Tensor) -> Tensor:
        """The prior, and φ held at its node."""
        constraint = torch.cat([turn_gradient(state), (nodes.turn - turn(state))[..., None]], dim=-1) / _HELD
        return torch.cat([further(state), constraint[..., None, :]], dim=-2)

    found = find_mode(problem, rows, nodes.start, _NODE_ITERATIONS, _NODE_DISTANCE)
    log_det = 2 * found.here.root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
    log_weight = nodes.log_weight - (found.here.cost + log_det) / 2
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
    """φ, rad: the angle of n about the scan line."""
    n = BoardState.split(state).n
    return torch.atan2(n[..., 2], n[..., 1])


def turn_gradient(state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state"]:
    """Derivative of φ by the state."""
    n2, n3 = state[..., -2], state[..., -1]
    by_motion = torch.stack([-n3, n2], dim=-1) / (n2.square() + n3.square())[..., None]
    return torch.cat([torch.zeros_like(state[..., :-2]), by_motion], dim=-1)


def _nodes(mode: Mode) -> _Nodes:
    """Nodes of Gauss-Hermite quadrature about the mode, as wide as its tangent says, on the tangent."""
    points, weights = (mode.state.new_tensor(values) for values in np.polynomial.hermite_e.hermegauss(_NODES))
    factor = mode.here.factor
    along = apply(factor.mT.contiguous(), turn_gradient(mode.state))
    sigma = torch.linalg.vector_norm(along, dim=-1)
    tangent = apply(factor, along) / sigma[..., None].square()  # change of the state by φ
    by_node = (-1, *(1,) * sigma.ndim)
    offset = sigma.clamp(max=_FARTHEST / float(points.max())) * points.reshape(by_node)
    log_weight = weights.log().reshape(by_node) + points.square().reshape(by_node) / 2
    return _Nodes(turn(mode.state) + offset, step_from(mode.state, offset[..., None] * tangent), log_weight)
