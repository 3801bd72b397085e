"""Joint update by many measurements at once: iterated posterior linearisation in square-root information form.

Measurements reach the update as whitened rows ``[A | r]``: A dx = r up to unit noise for the increment dx of the state
from the present mean. The linearisation's error ~ N(0, S Sᵀ), which all measurements share, enters as latent
unknowns with unit prior, eliminated by the same QR: no covariance between measurements is ever formed, and the cost is
linear in their number. The prior is never replaced: only the point of linearisation moves, so data are counted once.

Source: García-Fernández, Svensson, Morelande & Särkkä 2015 (iteration); Raitoharju, Svensson, García-Fernández & Piché
2018 (damping); Bierman 1977, ch. IV (square-root information).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.cubature import Function, slr
from lsvision.estimation.gaussian import Gaussian, Prior
from lsvision.estimation.linalg import apply, lower_factor, solve_upper, upper_root

# A step may raise the cost (twice a negative log density) by this much before it is halved: less than the cost varies
# over the posterior itself, more than it differs between the posterior's mean and mode.
_COST_SLACK = 1.0
_HALVINGS = 8


class Info(IntEnum):
    """Status of one problem of a batch."""

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
    """Library API: rows of the model ``residual = A dx + factor ξ + noise``, reduced to at most state + 1.

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
    """Library API: linearisation of any measurement function, for ``iterated_update``.

    Args:
        h: takes ``(points, *batch, state)`` to ``(points, *batch, blocks, size)``.
        measured: the measured values; NaN where ``valid`` is false.
        noise_chol: Cholesky factor of the noise ``(*batch, blocks, size, size)`` as a function of the mean.
    """
    blocks, size = measured.shape[-2:]

    def linearise(mean: Tensor, factor: Tensor) -> Rows:
        """Rows of all blocks, by statistical linear regression."""
        model = slr(lambda x: h(x).flatten(-2), mean, lower_factor(factor))
        residual = measured - model.at(mean).unflatten(-1, (blocks, size))
        residual = torch.where(valid[..., None], residual, 0.0)
        A, error = (matrix.unflatten(-2, (blocks, size)) for matrix in (model.A, model.error))
        return whitened_rows(A, residual, error, noise_chol(mean), valid)

    return linearise


def iterated_update(
    linearise: Linearise, prior: Prior, start: Gaussian, *, max_iterations: int = 20, tolerance: float = 1e-9
) -> Posterior:
    """Posterior given the prior and all measurements, relinearised about itself until it stands still.

    Args:
        linearise: see ``measurement``.
        start: Gaussian about which the first pass linearises; it carries no information. Its factor is triangular.
        tolerance: Kullback-Leibler divergence, nats, between two iterates below which a problem has converged.
    """
    objective = _Objective(linearise, prior)
    here, factor = objective.at(start.mean, start.factor), start.factor
    running = torch.isfinite(here.cost)
    failed, path, iterations = ~running, [here.mean], torch.zeros_like(running, dtype=torch.long)
    for _ in range(max_iterations):
        target = objective.minimum(here)
        divergence = _divergence(target, here.mean, factor)
        ok = torch.isfinite(divergence) & torch.isfinite(target.mean).all(-1)
        failed = failed | (running & ~ok)
        moved, running = running & ok, running & ok & (divergence > tolerance)
        factor = torch.where(moved[..., None, None], target.factor, factor)
        iterations = iterations + moved
        if not bool(running.any()):  # nothing is linearised about a last step
            path.append(torch.where(moved[..., None], target.mean, here.mean))
            break
        ahead = objective.damped(here, target, running)
        here = replace(ahead, mean=torch.where(moved[..., None], ahead.mean, here.mean))
        path.append(here.mean)
    info = torch.where(failed, int(Info.SINGULAR), torch.where(running, int(Info.NOT_CONVERGED), int(Info.OK)))
    return Posterior(path[-1], factor, torch.stack(path), iterations, ~failed & ~running, info)


@dataclass(frozen=True)
class _Point:
    """A mean, the rows about it, and the cost at it."""

    mean: Tensor
    rows: Rows
    cost: Tensor


@dataclass(frozen=True)
class _Target:
    """Posterior under linearised measurements: mean, covariance factor and information root, its inverse."""

    mean: Tensor
    factor: Tensor
    root: Tensor


@dataclass(frozen=True)
class _Objective:
    """The cost that the iteration lowers: twice the negative log density of measurements and prior, less a constant."""

    linearise: Linearise
    prior: Prior

    def at(self, mean: Tensor, factor: Tensor) -> _Point:
        """The measurements linearised about a Gaussian."""
        rows = self.linearise(mean, factor)
        from_prior = self.prior.residual(mean)
        cost = rows.matrix[..., -1].square().sum(-1) + from_prior.square().sum(-1) + rows.log_det
        return _Point(mean, rows, cost)

    def minimum(self, here: _Point) -> _Target:
        """The full step: the minimum of the objective with the measurements as they are linearised."""
        mean, prior_root = here.mean, self.prior.root
        to_prior = -self.prior.residual(mean)[..., None]
        prior_rows = torch.cat([prior_root, to_prior], -1).expand(*mean.shape[:-1], -1, -1)
        triangle = upper_root(torch.cat([prior_rows, here.rows.matrix], -2))
        state = mean.shape[-1]
        root, right = triangle[..., :state, :state], triangle[..., :state, state:]
        eye = torch.eye(state, dtype=mean.dtype, device=mean.device).expand_as(root)
        solution = solve_upper(root, torch.cat([eye, right], -1))
        return _Target(mean + solution[..., state], solution[..., :state], root)

    def damped(self, here: _Point, target: _Target, running: Tensor) -> _Point:
        """As far towards the target as the cost does not rise; mostly the full step.

        Problems that are not running any more take the full step: it is too short to overshoot.
        """
        step = torch.ones_like(here.cost)
        for _ in range(_HALVINGS):
            ahead = self.at(here.mean + step[..., None] * (target.mean - here.mean), target.factor)
            high = running & (ahead.cost > here.cost + _COST_SLACK)
            if not bool(high.any()):
                break
            step = torch.where(high, step / 2, step)
        return ahead


def _divergence(new: _Target, old_mean: Tensor, old_factor: Tensor) -> Tensor:
    """Kullback-Leibler divergence, nats, of the old Gaussian from the new one."""
    ratio = new.root @ old_factor
    log_det = _log_diagonal(new.root) + _log_diagonal(old_factor)
    distance = apply(new.root, new.mean - old_mean).square().sum(-1)
    return (ratio.square().sum((-2, -1)) - old_mean.shape[-1] + distance) / 2 - log_det


def _log_diagonal(triangle: Tensor) -> Tensor:
    """Log-determinant of triangular matrices, but for the sign."""
    return triangle.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
