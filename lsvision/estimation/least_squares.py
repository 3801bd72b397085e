"""Levenberg-Marquardt least squares with the Jacobian by forward differentiation: the reference for the filters.

Source: Marquardt 1963; Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear Least Squares Problems, sec. 3.2.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.derivative import jacobian as jacobian_of
from lsvision.estimation.linalg import apply, solve_upper, upper_root

_FIRST_DAMPING = 1e-6  # of the Jacobian's columns, scaled to unit length
_LARGEST_DAMPING = 1e8
# Relative rounding of a sum of squares: a step that changes less than that is as good as one that lowers it.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class LeastSquares:
    """Minimum of ‖residual‖²; ``factor @ factor.mT`` is (Jᵀ J)⁻¹ at it, ``path`` the state by iteration."""

    state: Float[Tensor, "*batch state"]
    factor: Float[Tensor, "*batch state state"]
    path: Float[Tensor, "iterations *batch state"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]


def levenberg_marquardt(
    residual: Callable[[Tensor], Tensor],
    start: Float[Tensor, "*batch state"],
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
) -> LeastSquares:
    """Minimise ‖residual(x)‖² for a batch of independent problems.

    Args:
        residual: takes ``(*batch, state)`` to whitened residuals ``(*batch, rows)``; at least as many rows as states.
        tolerance: length of a step, in sigmas of the state, at which a problem has converged.
    """
    state, values, path = start, residual(start), [start]
    damping = torch.full_like(start[..., 0], _FIRST_DAMPING)
    running = torch.isfinite(values).all(-1)
    iterations, converged = torch.zeros_like(running, dtype=torch.long), torch.zeros_like(running)
    for _ in range(max_iterations):
        jacobian = _batch_jacobian(residual, state)
        step = _damped_step(jacobian, values, damping)
        trial = state + step
        trial_values = residual(trial)
        better = running & (trial_values.square().sum(-1) <= (1 + _ROUNDING) * values.square().sum(-1))
        state = torch.where(better[..., None], trial, state)
        values = torch.where(better[..., None], trial_values, values)
        iterations = iterations + running
        path.append(state)
        damping = torch.where(better, damping / 10, damping * 10)
        length = apply(jacobian, step).square().sum(-1).sqrt()
        settled = (length <= tolerance) & (damping <= 1)  # damping made the other steps short
        converged = converged | (running & settled)
        running = running & ~settled & (damping < _LARGEST_DAMPING)
        if not bool(running.any()):
            break
    root = upper_root(_batch_jacobian(residual, state))
    eye = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device).expand_as(root)
    factor = solve_upper(root, eye)
    return LeastSquares(state, factor, torch.stack(path), iterations, converged)


def _damped_step(jacobian: Tensor, values: Tensor, damping: Tensor) -> Tensor:
    """Solution dx of min ‖J dx + r‖² + damping ‖D dx‖², D the lengths of J's columns."""
    lengths = torch.linalg.vector_norm(jacobian, dim=-2)
    weight = torch.diag_embed(lengths * damping.sqrt()[..., None])
    right = torch.cat([-values, torch.zeros_like(lengths)], dim=-1)
    triangle = upper_root(torch.cat([torch.cat([jacobian, weight], -2), right[..., None]], -1))
    size = lengths.shape[-1]
    return solve_upper(triangle[..., :size, :size], triangle[..., :size, size:])[..., 0]


def _batch_jacobian(residual: Callable[[Tensor], Tensor], state: Tensor) -> Tensor:
    """Derivative ``(*batch, rows, state)`` of a function that works problem by problem.

    All problems are moved along one direction e_i at a time, which gives column i of every J.
    """
    offset = torch.zeros_like(state[(0,) * (state.ndim - 1)])
    return jacobian_of(lambda move: residual(state + move), offset)
