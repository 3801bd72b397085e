"""Square-root cubature Kalman filter for any batch of independent problems.

State x, mean m, covariance P = L Lᵀ; process noise Q and measurement noise R as Cholesky factors too:

    predict   x' = f(x) + q          tria [odd_f, even_f, √Q]
    update    z  = h(x) + r          [odd_h  even_h  √R]   rotated to   [√S  0]
                                     [  L      0     0 ]                [ G  L']

with the moments of ``cubature.sigma_moments``, S the innovation's covariance and G √S⁻¹ the gain. Points are redrawn
after Q is added. Within the kernels the batch is last: means (state, *batch), factors (state, columns, *batch).

Source: Arasaratnam & Haykin 2009, sec. VI (square-root form); cuthbert (array form).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.cubature import Function, sigma_moments
from lsvision.estimation.joint import Info
from lsvision.estimation.square_root import absorb, forward_substitute


@dataclass(frozen=True)
class Update:
    """A filtered state and what the measurement said: S = innovation_chol innovation_cholᵀ.

    Where the measurement is missing the innovation is zero and its log-likelihood too.
    """

    mean: Float[Tensor, "*batch state"]
    chol: Float[Tensor, "*batch state state"]
    innovation: Float[Tensor, "*batch measurement"]
    innovation_chol: Float[Tensor, "*batch measurement measurement"]
    log_likelihood: Float[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]


@dataclass(frozen=True)
class Track:
    """A filtered sequence, time first. Factors hold ``factor @ factor.mT`` = covariance and need not be triangular.

    ``factors`` holds one a step, or the last alone where a history was not asked for.
    """

    means: Float[Tensor, "steps *batch state"]
    factors: Float[Tensor, "kept *batch state state"]
    whitened_innovations: Float[Tensor, "steps *batch measurement"]
    log_likelihood: Float[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]


def predict(
    f: Function | None,
    mean: Float[Tensor, "*batch state"],
    chol: Float[Tensor, "*batch state state"],
    noise_chol: Float[Tensor, "*#batch state state"],
) -> tuple[Float[Tensor, "*batch state"], Float[Tensor, "*batch state state"]]:
    """Mean and Cholesky factor after x' = f(x) + q, q ~ N(0, Q).

    Args:
        f: see ``cubature.Function``; None is a random walk, x' = x + q.
        noise_chol: Cholesky factor of Q; may be zero.
    """
    noise = noise_chol.expand_as(chol)
    moved, factor = _predict(f, _batch_last(mean, 1), _batch_last(chol, 2), _batch_last(noise, 2))
    return _batch_first(moved, 1), _batch_first(factor, 2)


def update(
    h: Function,
    mean: Float[Tensor, "*batch state"],
    chol: Float[Tensor, "*batch state state"],
    measured: Float[Tensor, "*batch measurement"],
    noise_chol: Float[Tensor, "*#batch measurement measurement"],
    valid: Bool[Tensor, "*batch"] | None = None,
) -> Update:
    """Filtered state given one measurement z = h(x) + r, r ~ N(0, R).

    Args:
        h: see ``cubature.Function``.
        noise_chol: Cholesky factor of R.
        valid: where something was measured; elsewhere the state stays as it is and ``measured`` may be NaN.
    """
    noise = noise_chol.expand(*measured.shape, measured.shape[-1])
    mean_last = _batch_last(mean, 1)
    new_mean, factor, innovation, root, whitened = _update(
        h, mean_last, _batch_last(chol, 2), _batch_last(measured, 1), _batch_last(noise, 2), valid
    )
    lower = absorb(factor.new_zeros(len(mean_last), *mean_last.shape), factor)[0]
    filtered, filtered_chol = _batch_first(new_mean, 1), _batch_first(lower, 2)
    return Update(
        mean=filtered,
        chol=filtered_chol,
        innovation=_batch_first(innovation, 1),
        innovation_chol=_batch_first(root, 2),
        log_likelihood=_log_likelihood(_batch_first(whitened, 1), _batch_first(_diagonal(root), 1), valid),
        info=_info(chol, noise.diagonal(dim1=-2, dim2=-1), filtered, filtered_chol),
    )


def filter_sequence(
    h: Callable[[Tensor, int], Tensor],
    mean: Float[Tensor, "*batch state"],
    chol: Float[Tensor, "*batch state state"],
    measured: Float[Tensor, "steps *batch measurement"],
    noise_chol: Float[Tensor, "*#each measurement measurement"],
    process_chol: Float[Tensor, "*#each state state"],
    f: Function | None = None,
    valid: Bool[Tensor, "steps *batch"] | None = None,
    *,
    history: bool = True,
) -> Track:
    """Filter a sequence: predict, then update, at every step.

    Args:
        h: called as ``h(points, step)``, otherwise as ``cubature.Function``.
        mean, chol: state before the first prediction.
        noise_chol, process_chol: Cholesky factors of R and Q, leading dimensions broadcast to ``(steps, *batch)``.
        f: transition; None is a random walk.
        valid: where something was measured.
        history: keep the factors of all steps, as the smoother needs; for many long sequences they fill the memory.
    """
    noise, process = (
        noise_chol.expand(*measured.shape, measured.shape[-1]),
        process_chol.expand(len(measured), *chol.shape),
    )
    noises, processes = (chols.movedim((-2, -1), (1, 2)) for chols in (noise, process))
    x, factor, values = _batch_last(mean, 1), _batch_last(chol, 2), measured.movedim(-1, 1).contiguous()
    factors: list[Tensor] = []
    means: list[Tensor] = []
    whitened: list[Tensor] = []
    pivots: list[Tensor] = []
    for step, value in enumerate(values):
        seen = None if valid is None else valid[step]
        x, factor = _predict(f, x, factor, processes[step])
        x, factor, _, root, white = _update(partial(_at_step, h, step), x, factor, value, noises[step], seen)
        factors = [*(factors if history else []), factor]
        for record, item in zip((means, whitened, pivots), (x, white, _diagonal(root)), strict=True):
            record.append(item)
    innovations, path = (torch.stack(record).movedim(1, -1) for record in (whitened, means))
    path_factors = torch.stack(factors if history else factors[-1:]).movedim((1, 2), (-2, -1))
    log_likelihood = _log_likelihood(innovations, torch.stack(pivots).movedim(1, -1), valid)
    info = _info(chol, noise.diagonal(dim1=-2, dim2=-1).amin(0), path[-1], path_factors[-1])
    return Track(path, path_factors, innovations, log_likelihood.sum(0), info)


def _at_step(h: Callable[[Tensor, int], Tensor], step: int, points: Tensor) -> Tensor:
    return h(points, step)


def _predict(f: Function | None, mean: Tensor, factor: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Predicted mean and lower triangular factor; batch last."""
    if f is None:
        return mean, absorb(noise, factor)[0]
    center, odd, even = sigma_moments(f, mean, factor)
    return center, absorb(noise, torch.cat([odd, even], dim=1))[0]


def _update(
    h: Function, mean: Tensor, factor: Tensor, measured: Tensor, noise: Tensor, valid: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Filtered mean, a factor of its covariance, innovation, √S lower triangular, whitened innovation; batch last."""
    center, odd, even = sigma_moments(h, mean, factor)
    innovation = measured - center
    if valid is not None:
        innovation, odd, even = (torch.where(valid, part, 0.0) for part in (innovation, odd, even))
    root, _ = absorb(noise, even)
    root, remainder = absorb(root, odd, factor)
    root, gain = root[: len(measured)], root[len(measured) :]
    whitened = forward_substitute(root, innovation[:, None])[:, 0]
    for column, part in zip(gain.unbind(1), whitened, strict=True):
        mean = torch.addcmul(mean, column, part)
    return mean, remainder, innovation, root, whitened


def _log_likelihood(whitened: Tensor, pivots: Tensor, valid: Tensor | None) -> Tensor:
    """Log density of innovations, given whitened and with the diagonal of √S; zero where nothing was measured."""
    terms = whitened.square() / 2 + pivots.log() + math.log(2 * math.pi) / 2
    return -(terms if valid is None else torch.where(valid[..., None], terms, 0.0)).sum(-1)


def _diagonal(root: Tensor) -> Tensor:
    return root.diagonal(dim1=0, dim2=1).movedim(-1, 0)


def _info(chol: Tensor, noise_pivots: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """Status by problem: the covariances it was given are positive definite, and its result is finite."""
    given = (chol.diagonal(dim1=-2, dim2=-1) > 0).all(-1) & (noise_pivots > 0).all(-1)
    finite = torch.isfinite(mean).all(-1) & torch.isfinite(factor).all((-2, -1))
    return torch.where(given & finite, int(Info.OK), int(Info.SINGULAR))


def _batch_last(tensor: Tensor, own: int) -> Tensor:
    """The last ``own`` dimensions first, the batch contiguous."""
    return tensor.movedim(tuple(range(-own, 0)), tuple(range(own))).contiguous()


def _batch_first(tensor: Tensor, own: int) -> Tensor:
    return tensor.movedim(tuple(range(own)), tuple(range(-own, 0)))
