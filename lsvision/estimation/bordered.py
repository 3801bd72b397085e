"""Least squares with unknowns of single blocks beside unknowns that all blocks share, as poses beside a camera.

The rows of a block are reduced by an orthogonal triangularisation: what stands below its own unknowns speaks of the
shared ones alone. An iteration costs as much as there are blocks. Gauss-Newton steps are halved where they overshoot.

Source: Björck 1996, Numerical Methods for Least Squares Problems, sec. 6.3; Triggs et al. 2000, Bundle Adjustment - A
Modern Synthesis, sec. 6.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.derivative import jacobian
from lsvision.estimation.linalg import apply, solve_upper, upper_root

_HALVINGS = 6
_ROUNDING = 1e-12  # relative, of a sum of squares


@dataclass(frozen=True)
class BorderedState:
    """Unknowns that all blocks share, and those of each block."""

    shared: Float[Tensor, "*batch shared"]
    own: Float[Tensor, "*batch blocks own"]

    def moved(self, step: "BorderedState", share: Float[Tensor, "*#batch"]) -> "BorderedState":
        """The state after a part of a step."""
        return BorderedState(self.shared + share[..., None] * step.shared, self.own + share[..., None, None] * step.own)


@dataclass(frozen=True)
class BorderedFit:
    """Minimum of ‖residual‖² + ‖shared‖²; ``factor @ factor.mT`` is the covariance of the shared unknowns."""

    state: BorderedState
    factor: Float[Tensor, "*batch shared shared"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]


def bordered_least_squares(
    residual: Callable[[BorderedState], Float[Tensor, "*batch blocks rows"]],
    start: BorderedState,
    *,
    max_iterations: int = 30,
    tolerance: float = 0.01,
) -> BorderedFit:
    """Minimise ‖residual‖² + ‖shared‖² for a batch of independent problems.

    The shared unknowns are in units of their prior's sigma from its mean; those of the blocks have a flat prior.

    Args:
        residual: whitened residuals of each block, which depend on the shared unknowns and on its own; at least as many
            rows as there are unknowns of both kinds.
        tolerance: length of a step, in sigmas of all unknowns, at which a problem has converged.
    """
    state, cost = start, _cost(residual, start)
    iterations = torch.zeros_like(cost, dtype=torch.long)
    converged = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(max_iterations):
        step = _Step.of(residual, state)
        running = ~converged
        iterations = iterations + running
        share, lower = torch.ones_like(cost), cost
        for _ in range(_HALVINGS):
            lower = _cost(residual, state.moved(step.step, share))
            over = ~(lower <= (1 + _ROUNDING) * cost)
            if not bool((over & running).any()):
                break
            share = torch.where(over, share / 2, share)
        share = torch.where(running & (lower <= (1 + _ROUNDING) * cost), share, 0.0)
        state = state.moved(step.step, share)
        cost = torch.where(share > 0, lower, cost)
        converged = converged | (running & (step.length <= tolerance))
        if bool((converged | (share == 0)).all()):
            break
    return BorderedFit(state, _Step.of(residual, state).factor, iterations, converged)


def shared_information(
    residual: Callable[[BorderedState], Float[Tensor, "*batch blocks rows"]], state: BorderedState
) -> Float[Tensor, "*batch blocks shared shared"]:
    """Information of each block on the shared unknowns, its own unknown: without a prior."""
    roots = _roots(residual, state)
    below = roots.of_shared[..., :-1]
    return below.mT @ below


@dataclass(frozen=True)
class _Roots:
    """Triangular roots of each block's rows ``[own | shared | residual]``: the rows with its own unknowns, the rest."""

    of_own: Float[Tensor, "*batch blocks own columns"]
    of_shared: Float[Tensor, "*batch blocks rest shared_and_one"]


def block_rows(
    residual: Callable[[BorderedState], Float[Tensor, "*batch blocks rows"]], state: BorderedState
) -> Float[Tensor, "*batch blocks rows columns"]:
    """Derivatives of each block's residuals by its own unknowns and by the shared ones, then the residuals."""
    own, shared = state.own.shape[-1], state.shared.shape[-1]

    def moved(move: Tensor) -> Tensor:
        return residual(BorderedState(state.shared + move[own:], state.own + move[:own]))

    rows = jacobian(moved, state.shared.new_zeros(own + shared))
    return torch.cat([rows, residual(state)[..., None]], dim=-1)


def _roots(residual: Callable[[BorderedState], Tensor], state: BorderedState) -> _Roots:
    own = state.own.shape[-1]
    root = upper_root(block_rows(residual, state))
    return _Roots(root[..., :own, :], root[..., own:, own:])


@dataclass(frozen=True)
class _Step:
    """A Gauss-Newton step, its length in sigmas, and the factor of the shared unknowns' covariance."""

    step: BorderedState
    length: Float[Tensor, "*batch"]
    factor: Float[Tensor, "*batch shared shared"]

    @classmethod
    def of(cls, residual: Callable[[BorderedState], Tensor], state: BorderedState) -> "_Step":
        """The step from a state, by a triangular root of all rows, those of the prior included."""
        own, shared = state.own.shape[-1], state.shared.shape[-1]
        roots = _roots(residual, state)
        eye = torch.eye(shared, dtype=state.shared.dtype, device=state.shared.device).expand(
            *state.shared.shape, shared
        )
        prior = torch.cat([eye, state.shared[..., None]], dim=-1)
        whole = upper_root(torch.cat([roots.of_shared.flatten(-3, -2), prior], dim=-2))
        factor, right = solve_upper(whole[..., :shared, :shared], eye), whole[..., :shared, shared]
        move = -apply(factor, right)
        rest = roots.of_own[..., -1] + apply(roots.of_own[..., own:-1], move[..., None, :])
        of_own = -solve_upper(roots.of_own[..., :own], rest[..., None])[..., 0]
        length = (right.square().sum(-1) + rest.square().sum((-2, -1))).sqrt()
        return cls(BorderedState(move, of_own), length, factor)


def _cost(residual: Callable[[BorderedState], Tensor], state: BorderedState) -> Float[Tensor, "*batch"]:
    return residual(state).square().sum((-2, -1)) + state.shared.square().sum(-1)
