"""Square-root cubature Kalman filter for any batch of independent problems.

State x, mean m, covariance P = L Lᵀ; process noise Q and measurement noise R as Cholesky factors too:

    predict   x' = f(x) + q          tria [odd_f, even_f, √Q]
    update    z  = h(x) + r          [odd_h  even_h  √R]   rotated to   [√S  0]
                                     [  L      0     0 ]                [ G  L']

with the moments of ``cubature.sigma_moments``, S the innovation's covariance and G √S⁻¹ the gain. Points are redrawn
after Q is added. Within the kernels the batch is last: means (state, *batch), factors (state, columns, *batch).

``filter_sequence`` runs a whole sequence. ``predict`` and ``update`` are library API: the two steps alone, for filters
whose model changes from step to step.

Source: Arasaratnam & Haykin 2009, sec. VI (square-root form); cuthbert (array form).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation.cubature import Function, sigma_moments
from lsvision.estimation.gaussian import BatchLast, Gaussian
from lsvision.estimation.joint import Info
from lsvision.estimation.linalg import absorb, batch_first, batch_last, forward_substitute


@dataclass(frozen=True)
class StateSpace:
    """A model of a sequence: x' = f(x) + q from step to step, z = h(x, step) + r at each; q ~ N(0, Q), r ~ N(0, R).

    ``h`` is called as ``h(points, step)``, otherwise as ``cubature.Function``. ``noise_chol`` and ``process_chol`` are
    Cholesky factors of R and Q, leading dimensions broadcast to ``(steps, *batch)``; Q may be zero. Without ``f`` the
    state is a random walk.
    """

    h: Callable[[Tensor, int], Tensor]
    noise_chol: Float[Tensor, "*noises measurement measurement"]
    process_chol: Float[Tensor, "*processes state state"]
    f: Function | None = None

    def measured_at(self, step: int) -> Function:
        """h at one step."""
        return lambda points: self.h(points, step)


@dataclass(frozen=True)
class Update:
    """A filtered state and the innovation of its measurement: S = innovation_chol innovation_cholᵀ.

    The state's factor is lower triangular. Where the measurement is missing the innovation is zero and its
    log-likelihood too.
    """

    state: Gaussian
    innovation: Float[Tensor, "*batch measurement"]
    innovation_chol: Float[Tensor, "*batch measurement measurement"]
    log_likelihood: Float[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]


@dataclass(frozen=True)
class Track:
    """A filtered sequence, time first. Factors hold ``factor @ factor.mT`` = covariance and need not be triangular.

    ``factors`` holds one per step, or the last alone where a history was not asked for.
    """

    means: Float[Tensor, "steps *batch state"]
    factors: Float[Tensor, "kept *batch state state"]
    whitened_innovations: Float[Tensor, "steps *batch measurement"]
    log_likelihood: Float[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]

    @property
    def last(self) -> Gaussian:
        """The state after the last step."""
        return Gaussian(self.means[-1], self.factors[-1])


def predict(f: Function | None, state: Gaussian, noise_chol: Float[Tensor, "*#batch state state"]) -> Gaussian:
    """Library API: the state after x' = f(x) + q, q ~ N(0, Q); its factor is lower triangular.

    Args:
        f: see ``cubature.Function``; None is a random walk, x' = x + q.
        noise_chol: Cholesky factor of Q; may be zero.
    """
    noise = noise_chol.expand_as(state.factor)
    return _predict(f, BatchLast.of(state), batch_last(noise, 2)).gaussian()


def update(
    h: Function,
    state: Gaussian,
    measured: Float[Tensor, "*batch measurement"],
    noise_chol: Float[Tensor, "*#batch measurement measurement"],
    valid: Bool[Tensor, "*batch"] | None = None,
) -> Update:
    """Library API: filtered state given one measurement z = h(x) + r, r ~ N(0, R).

    Args:
        h: see ``cubature.Function``.
        state: before the measurement; its factor is a Cholesky factor.
        noise_chol: Cholesky factor of R.
        valid: where something was measured; elsewhere the state stays as it is and ``measured`` may be NaN.
    """
    noise = noise_chol.expand(*measured.shape, measured.shape[-1])
    step = _update(h, BatchLast.of(state), batch_last(measured, 1), batch_last(noise, 2), valid)
    mean, factor = step.state.mean, step.state.factor
    lower = absorb(factor.new_zeros(len(mean), *mean.shape), factor)[0]
    filtered = BatchLast(mean, lower).gaussian()
    return Update(
        state=filtered,
        innovation=batch_first(step.innovation, 1),
        innovation_chol=batch_first(step.root, 2),
        log_likelihood=_log_likelihood(batch_first(step.whitened, 1), batch_first(step.pivots, 1), valid),
        info=_info(state.factor, noise.diagonal(dim1=-2, dim2=-1), filtered),
    )


def filter_sequence(
    model: StateSpace,
    start: Gaussian,
    measured: Float[Tensor, "steps *batch measurement"],
    valid: Bool[Tensor, "steps *batch"] | None = None,
    *,
    history: bool = True,
) -> Track:
    """Filter a sequence: predict, then update, at every step.

    Args:
        start: state before the first prediction; its factor is a Cholesky factor.
        valid: where something was measured; elsewhere ``measured`` may be NaN.
        history: keep the factors of all steps, as the smoother needs; for many long sequences they fill the memory.
    """
    noise = model.noise_chol.expand(*measured.shape, measured.shape[-1])
    process = model.process_chol.expand(len(measured), *start.factor.shape)
    noises, processes = (chols.movedim((-2, -1), (1, 2)) for chols in (noise, process))
    state, values = BatchLast.of(start), measured.movedim(-1, 1).contiguous()
    factors: list[Tensor] = []
    records: list[tuple[Tensor, ...]] = []
    for k, value in enumerate(values):
        seen = None if valid is None else valid[k]
        predicted = _predict(model.f, state, processes[k])
        step = _update(model.measured_at(k), predicted, value, noises[k], seen)
        state = step.state
        records.append((state.mean, step.whitened, step.pivots))
        factors = [*(factors if history else []), state.factor]
    means, innovations, pivots = (torch.stack(record).movedim(1, -1) for record in zip(*records, strict=True))
    path_factors = torch.stack(factors).movedim((1, 2), (-2, -1))
    return Track(
        means=means,
        factors=path_factors,
        whitened_innovations=innovations,
        log_likelihood=_log_likelihood(innovations, pivots, valid).sum(0),
        info=_info(start.factor, noise.diagonal(dim1=-2, dim2=-1).amin(0), Gaussian(means[-1], path_factors[-1])),
    )


@dataclass(frozen=True)
class _Step:
    """One update, the batch last; ``root`` is √S, lower triangular, and ``whitened`` is √S⁻¹ times the innovation."""

    state: BatchLast
    innovation: Float[Tensor, "measurement *batch"]
    root: Float[Tensor, "measurement measurement *batch"]
    whitened: Float[Tensor, "measurement *batch"]

    @property
    def pivots(self) -> Float[Tensor, "measurement *batch"]:
        """Diagonal of √S."""
        return self.root.diagonal(dim1=0, dim2=1).movedim(-1, 0)


def _predict(f: Function | None, state: BatchLast, noise: Tensor) -> BatchLast:
    """Predicted state, its factor lower triangular."""
    if f is None:
        return BatchLast(state.mean, absorb(noise, state.factor)[0])
    moments = sigma_moments(f, state.mean, state.factor)
    return BatchLast(moments.center, absorb(noise, moments.factor)[0])


def _update(h: Function, state: BatchLast, measured: Tensor, noise: Tensor, valid: Tensor | None) -> _Step:
    moments = sigma_moments(h, state.mean, state.factor)
    innovation, odd, even = measured - moments.center, moments.odd, moments.even
    if valid is not None:
        innovation, odd, even = (torch.where(valid, part, 0.0) for part in (innovation, odd, even))
    root, _ = absorb(noise, even)
    root, remainder = absorb(root, odd, state.factor)
    root, gain = root[: len(measured)], root[len(measured) :]
    whitened = forward_substitute(root, innovation[:, None])[:, 0]
    mean = state.mean
    for column, part in zip(gain.unbind(1), whitened, strict=True):
        mean = torch.addcmul(mean, column, part)
    return _Step(BatchLast(mean, remainder), innovation, root, whitened)


def _log_likelihood(whitened: Tensor, pivots: Tensor, valid: Tensor | None) -> Tensor:
    """Log density of innovations, given whitened and with the diagonal of √S; zero where nothing was measured."""
    terms = whitened.square() / 2 + pivots.log() + math.log(2 * math.pi) / 2
    return -(terms if valid is None else torch.where(valid[..., None], terms, 0.0)).sum(-1)


def _info(chol: Tensor, noise_pivots: Tensor, result: Gaussian) -> Tensor:
    """Status by problem: OK where the given covariances are positive definite and the result is finite."""
    given = (chol.diagonal(dim1=-2, dim2=-1) > 0).all(-1) & (noise_pivots > 0).all(-1)
    finite = torch.isfinite(result.mean).all(-1) & torch.isfinite(result.factor).all((-2, -1))
    return torch.where(given & finite, int(Info.OK), int(Info.SINGULAR))
