"""The most likely state by Gauss-Newton on the exact model, from far away too.

The measured x, travel and z of a point of the object are linear in (n1, 1, n3) / n2 when its pose is known. A step of
Gauss-Newton that is taken in these three needs no damping, whatever n it starts from: under half the nominal motion the
first step would otherwise pass n2 = 0. And it must not be damped: along the curve of states that fit, every straight
step raises the cost before the next one lowers it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation import Prior, lower_factor, solve_upper, upper_root
from lsvision.stages.calibration.linearise import linearise, point_factor
from lsvision.stages.calibration.problem import BoardProblem

# The least and the largest change of 1 / n2 in a step: its sign stays.
_LEAST_RATIO, _LARGEST_RATIO = 0.2, 5.0

FurtherRows = Callable[[Tensor], Tensor]
"""Takes states ``(*batch, state)`` to the whitened rows ``[A | r]`` of a prior or a constraint about them."""


@dataclass(frozen=True)
class Step:
    """A full step of Gauss-Newton from a state, and what is known there.

    ``distance`` is its length in sigmas of all unknowns together: half its square is what the step gains, in nats.
    ``root`` is the upper triangular root of the information, ``cost`` the sum of all squared residuals.
    """

    step: Float[Tensor, "*batch state"]
    distance: Float[Tensor, "*batch"]
    root: Float[Tensor, "*batch state state"]
    cost: Float[Tensor, "*batch"]

    @property
    def factor(self) -> Float[Tensor, "*batch state state"]:
        """Factor of the covariance: the inverse of the root."""
        eye = torch.eye(self.root.shape[-1], dtype=self.root.dtype, device=self.root.device)
        return solve_upper(self.root, eye.expand_as(self.root)).contiguous()  # sums over rows take one order

    @property
    def widened_factor(self) -> Float[Tensor, "*batch state state"]:
        """Lower triangular factor of the covariance and the square of the step that is still missing."""
        return lower_factor(torch.cat([self.factor, self.step[..., None]], dim=-1))


@dataclass(frozen=True)
class Mode:
    """A state of least cost, and the step from it; ``path`` is the state by iteration, from the start."""

    state: Float[Tensor, "*batch state"]
    here: Step
    path: Float[Tensor, "iterations *batch state"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]


def find_mode(
    problem: BoardProblem, further: FurtherRows, start: Float[Tensor, "*batch state"], iterations: int, distance: float
) -> Mode:
    """The state of least cost of the corners and the further rows.

    Args:
        start: may have more leading dimensions than the problem.
        iterations: at most so many steps.
        distance: of a step at which a problem has converged, in sigmas.
    """
    state, path = start, [start]
    running = torch.ones_like(start[..., 0], dtype=torch.bool)
    taken = torch.zeros_like(running, dtype=torch.long)
    here = gauss_newton_step(problem, further, state)
    for _ in range(iterations):
        moved = running & torch.isfinite(here.step).all(-1)
        state = torch.where(moved[..., None], step_from(state, here.step), state)
        path.append(state)
        taken, running = taken + moved, moved & ~(here.distance <= distance)
        here = gauss_newton_step(problem, further, state)
        if not bool(running.any()):
            break
    return Mode(state, here, torch.stack(path), taken, here.distance <= distance)


def gauss_newton_step(problem: BoardProblem, further: FurtherRows, state: Float[Tensor, "*batch state"]) -> Step:
    """The step from a state to the least cost of all rows about it."""
    rows = torch.cat([further(state), linearise(problem, state, point_factor(state)).matrix], dim=-2)
    triangle, size = upper_root(rows), state.shape[-1]
    root, right = triangle[..., :size, :size], triangle[..., :size, size:]
    distance = right[..., 0].square().sum(-1).sqrt()
    return Step(solve_upper(root, right)[..., 0], distance, root, rows[..., -1].square().sum(-1))


def rows_of(prior: Prior) -> FurtherRows:
    """The rows of a prior."""

    def rows(state: Tensor) -> Tensor:
        """Those about a state."""
        residual = -prior.residual(state)[..., None]
        return torch.cat([prior.root.expand(*residual.shape[:-1], -1), residual], dim=-1)

    return rows


def step_from(
    state: Float[Tensor, "*#batch state"], step: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch state"]:
    """The state after a step whose part in n is taken in (n1, 1, n3) / n2."""
    moved, n, change = state + step, state[..., -3:], step[..., -3:]
    n2 = n[..., 1:2]
    ratio = (1 - change[..., 1:2] / n2).clamp(_LEAST_RATIO, _LARGEST_RATIO)  # of 1 / n2
    slope = n / n2
    slope = slope + (change - slope * change[..., 1:2]) / n2
    slope = torch.cat([slope[..., :1], torch.ones_like(ratio), slope[..., 2:]], dim=-1)
    return torch.cat([moved[..., :-3], slope * (n2 / ratio)], dim=-1)
