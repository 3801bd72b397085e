"""Joint update by many measurements at once: iterated posterior linearisation in square-root information form.

Measurements reach the update as whitened rows ``[A | r]``: the state's increment dx from the present mean is to fulfil
A dx = r up to unit noise. The linearisation's own error r ~ N(0, S Sᵀ), which all measurements share, enters as latent
unknowns with unit prior, eliminated by the same QR: no covariance between measurements is ever formed, and the cost is
linear in their number. The prior is never replaced: only the point of linearisation moves, so data are counted once.

Source: García-Fernández, Svensson, Morelande & Särkkä 2015 (iteration); Raitoharju, Svensson, García-Fernández & Piché
2018 (damping); Bierman 1977, ch. IV (square-root information).
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.cubature import Function, slr
from lsvision.estimation.triangular import apply, lower_factor, solve_upper, upper_root

# A step may raise the cost (twice a negative log density) by this much before it is halved: less than the posterior's
# own scatter, more than what separates the posterior's mean from its mode.
_COST_SLACK = 1.0
_HALVINGS = 8


class Info(IntEnum):
    """What became of one problem of a batch."""

    OK = 0
    NOT_CONVERGED = 1
    SINGULAR = 2  # bad input: not finite, or a covariance that is not positive definite


@dataclass(frozen=True)
class Rows:
    """Whitened measurements ``[A | r]`` about a state, and the log-determinant of the noise they were whitened by."""

    matrix: Float[Tensor, "*batch rows columns"]
    log_det: Float[Tensor, "*batch"]


Linearise = Callable[[Tensor, Tensor], Rows]
"""Takes a Gaussian's mean ``(*batch, state)`` and covariance factor ``(*batch, state, state)`` to rows about it."""


@dataclass(frozen=True)
class Posterior:
    """Result of ``iterated_update``; ``factor @ factor.mT`` is the covariance, ``path`` the mean by iteration.

    ``path`` begins with the start; past a problem's last iteration it repeats the result.
    """

    mean: Float[Tensor, "*batch state"]
    factor: Float[Tensor, "*batch state state"]
    path: Float[Tensor, "iterations *batch state"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]


def whitened_rows(
    A: Float[Tensor, "*batch blocks size state"],
    residual: Float[Tensor, "*batch blocks size"],
    factor: Float[Tensor, "*batch blocks size latents"],
    noise_chol: Float[Tensor, "*batch blocks size size"],
    valid: Bool[Tensor, "*batch blocks"],
) -> Rows:
    """Rows of the affine model ``residual = A dx + factor ξ + noise``, reduced to at most state + 1.

    Args:
        A, residual: model about the present mean, in blocks of jointly noisy components.
        factor: of the linearisation's error, common to all blocks: ξ ~ N(0, I).
        noise_chol: Cholesky factor of each block's noise.
        valid: blocks that were measured; the others may hold anything but NaN.
    """
    latents = factor.shape[-1]
    blocks = torch.linalg.solve_triangular(noise_chol, torch.cat([factor, A, residual[..., None]], -1), upper=False)
    blocks = torch.where(valid[..., None, None], blocks, 0.0).flatten(-3, -2)
    unit = torch.eye(latents, blocks.shape[-1], dtype=A.dtype, device=A.device)
    stacked = torch.cat([unit.expand(*blocks.shape[:-2], latents, -1), blocks], dim=-2)
    root = upper_root(stacked)
    by_latents = root[..., :latents, :latents].diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
    by_noise = noise_chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    log_det = 2 * (by_latents + torch.where(valid, by_noise, 0.0).sum(-1))
    return Rows(root[..., latents:, latents:], log_det)


def measurement(
    h: Function,
    measured: Float[Tensor, "*batch blocks size"],
    noise_chol: Callable[[Tensor], Tensor],
    valid: Bool[Tensor, "*batch blocks"],
) -> Linearise:
    """Linearisation of any measurement function, for ``iterated_update``.

    Args:
        h: takes ``(points, *batch, state)`` to ``(points, *batch, blocks, size)``.
        measured: what was measured; NaN where ``valid`` is false.
        noise_chol: Cholesky factor of the noise ``(*batch, blocks, size, size)`` as a function of the mean.
    """
    blocks, size = measured.shape[-2:]

    def linearise(mean: Tensor, factor: Tensor) -> Rows:
        """Rows of all blocks, by statistical linear regression."""
        A, b, error = slr(lambda x: h(x).flatten(-2), mean, lower_factor(factor))
        residual = measured - (apply(A, mean) + b).unflatten(-1, (blocks, size))
        residual = torch.where(valid[..., None], residual, 0.0)
        A, error = (matrix.unflatten(-2, (blocks, size)) for matrix in (A, error))
        return whitened_rows(A, residual, error, noise_chol(mean), valid)

    return linearise


def iterated_update(
    linearise: Linearise,
    prior_mean: Float[Tensor, "*batch state"],
    prior_root: Float[Tensor, "*batch rows state"],
    start_mean: Float[Tensor, "*batch state"],
    start_factor: Float[Tensor, "*batch state state"],
    *,
    max_iterations: int = 20,
    tolerance: float = 1e-9,
) -> Posterior:
    """Posterior given the prior and all measurements, relinearised about itself until it stands still.

    Args:
        linearise: see ``measurement``.
        prior_mean, prior_root: prior as ‖prior_root (x - prior_mean)‖²; zero rows are a flat prior.
        start_mean, start_factor: Gaussian about which the first pass linearises; no information of its own. The
            factor is triangular.
        tolerance: Kullback-Leibler divergence, nats, between two iterates below which a problem has converged.
    """
    mean, factor = start_mean, start_factor
    rows = linearise(mean, factor)
    running = torch.isfinite(_cost(rows, mean, prior_mean, prior_root))
    failed, path, iterations = ~running, [mean], torch.zeros_like(running, dtype=torch.long)
    for _ in range(max_iterations):
        target, new_factor, root = _solve(rows, mean, prior_mean, prior_root)
        divergence = _divergence(target - mean, root, factor)
        ok = torch.isfinite(divergence) & torch.isfinite(target).all(-1)
        failed = failed | (running & ~ok)
        moved, running = running & ok, running & ok & (divergence > tolerance)
        factor = torch.where(moved[..., None, None], new_factor, factor)
        iterations = iterations + moved
        if not bool(running.any()):  # nothing is linearised about a last step
            mean = torch.where(moved[..., None], target, mean)
            path.append(mean)
            break
        new_mean, rows = _damped(linearise, rows, mean, target, new_factor, running, prior_mean, prior_root)
        mean = torch.where(moved[..., None], new_mean, mean)
        path.append(mean)
    info = torch.where(failed, int(Info.SINGULAR), torch.where(running, int(Info.NOT_CONVERGED), int(Info.OK)))
    return Posterior(mean, factor, torch.stack(path), iterations, ~failed & ~running, info)


def _cost(rows: Rows, mean: Tensor, prior_mean: Tensor, prior_root: Tensor) -> Tensor:
    """Twice the negative log density of the measurements and the prior at ``mean``, but for a constant."""
    from_prior = apply(prior_root, mean - prior_mean)
    return rows.matrix[..., -1].square().sum(-1) + from_prior.square().sum(-1) + rows.log_det


def _solve(rows: Rows, mean: Tensor, prior_mean: Tensor, prior_root: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, covariance factor and information root of the posterior under the linearised measurements."""
    to_prior = apply(prior_root, prior_mean - mean)[..., None]
    stacked = torch.cat([torch.cat([prior_root, to_prior], -1).expand(*mean.shape[:-1], -1, -1), rows.matrix], -2)
    triangle = upper_root(stacked)
    state = mean.shape[-1]
    root, right = triangle[..., :state, :state], triangle[..., :state, state:]
    eye = torch.eye(state, dtype=mean.dtype, device=mean.device).expand_as(root)
    solution = solve_upper(root, torch.cat([eye, right], -1))
    return mean + solution[..., state], solution[..., :state], root


def _damped(
    linearise: Linearise,
    rows: Rows,
    mean: Tensor,
    target: Tensor,
    factor: Tensor,
    running: Tensor,
    prior_mean: Tensor,
    prior_root: Tensor,
) -> tuple[Tensor, Rows]:
    """As far towards ``target`` as the cost does not rise, and the rows there; mostly the full step.

    Problems that are not running any more take the full step: it is too short to overshoot.
    """
    ceiling = _cost(rows, mean, prior_mean, prior_root) + _COST_SLACK
    step = torch.ones_like(ceiling)
    for _ in range(_HALVINGS):
        candidate = mean + step[..., None] * (target - mean)
        new_rows = linearise(candidate, factor)
        high = running & (_cost(new_rows, candidate, prior_mean, prior_root) > ceiling)
        if not bool(high.any()):
            break
        step = torch.where(high, step / 2, step)
    return candidate, new_rows


def _divergence(move: Tensor, root: Tensor, old_factor: Tensor) -> Tensor:
    """Kullback-Leibler divergence, nats, of the old Gaussian from the new one (information root, upper triangular)."""
    ratio = root @ old_factor
    log_det = _log_diagonal(root) + _log_diagonal(old_factor)
    distance = apply(root, move).square().sum(-1)
    return (ratio.square().sum((-2, -1)) - move.shape[-1] + distance) / 2 - log_det


def _log_diagonal(triangle: Tensor) -> Tensor:
    return triangle.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
