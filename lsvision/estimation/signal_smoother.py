"""Fixed-interval smoother of signals: backwards through what ``signal_filter`` has filtered.

With K = S⁻¹ H P of a step, and [A | a] = [Fᵀ N F | Fᵀ r] from the step after it,

    r' = a + Hᵀ (S⁻¹ (z - H m) - K a),   N' = J A Jᵀ + Hᵀ S⁻¹ H,   J = 1 - Hᵀ K;   smoothed: m + P a,  P - P A P.

Source: Bierman 1973; de Jong 1989.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.signal_filter import Filtered, Measurements, SignalBlocks, StateMotion, StateRows


@dataclass(frozen=True)
class Smoothed:
    """Values of the signals given all measurements."""

    mean: Float[Tensor, "steps signals batch"]
    covariance: Float[Tensor, "steps signals signals batch"]


def smooth_blocks(blocks: SignalBlocks, measured: Measurements, filtered: Filtered, inner: slice) -> Smoothed:
    """Smooth a filtered sequence; the answer is for the steps ``inner``."""
    state, nothing = StateRows.of(torch.zeros_like(blocks.noise)), torch.zeros_like(blocks.noise)
    motion = StateMotion(blocks.transition.transpose(1, 2), nothing, state)
    information = _Information(measured, filtered, state)
    first, last, _ = inner.indices(len(filtered.values))
    kept = state.all.new_empty(last - first, *state.flat.shape)
    for k in reversed(range(first, len(filtered.values))):
        motion.advance()
        if k < last:
            kept[k - first] = state.flat
        information.take_in(k)
    P, m = filtered.values[inner, :, :-1], filtered.values[inner, :, -1]
    gained = _summed([(P[:, :, j, None], kept[:, None, j]) for j in range(kept.shape[1])])
    taken = _summed([(gained[:, :, j, None], P[:, None, :, j]) for j in range(kept.shape[1])])
    return Smoothed(m + gained[:, :, -1], P[:, :, :: blocks.start.shape[1]] - taken)


def _summed(pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Sum of products, from first to last."""
    total = pairs[0][0] * pairs[0][1]
    for left, right in pairs[1:]:
        total.addcmul_(left, right)
    return total


class _Information:
    """What later steps say about a state: [N | r], updated by the measurement of a step."""

    def __init__(self, measured: Measurements, filtered: Filtered, state: StateRows) -> None:
        """Solve for the gains of all steps, and keep the views that every step takes."""
        signals, size = len(state.values), state.all.shape[1]
        rows = range(signals * size)
        gain = _solved(filtered.eliminated, filtered.eliminated[:, :, signals:])
        observed = _solved(filtered.eliminated, _forward_substituted(filtered.eliminated, measured, size))
        self._state, self._minus_v, self._observed = state, gain[:, :, -1].unbind(), observed.unbind()
        self._gains = [gain[:, :, j, None].unbind() for j in rows]
        self._gains_across = [gain[:, None, :, j].unbind() for j in rows]
        self._rows, self._columns = list(state.flat), [state.flat[:, j, None] for j in rows]
        self._noise_rows = state.all[:, -1]
        columns = state.flat[:, :-1].unflatten(1, (signals, size))
        self._value_columns, self._noise_columns = columns[:, :, 0], columns[:, :, -1]
        self._lasting = [measured.lasting[:, i, :, None].unbind() for i in range(signals)]
        self._across = [measured.lasting[:, i, None].unbind() for i in range(signals)]

    def take_in(self, k: int) -> None:
        """Turn [A | a] into [N' | r'], J A Jᵀ from left to right: a sum of squares, which loses no digits."""
        signals, state = range(len(self._lasting)), self._state
        Y = _summed([(gain[k], row) for gain, row in zip(self._gains, self._rows, strict=True)])
        Y[:, -1] += self._minus_v[k]
        state.values.sub_(Y)
        for i in signals:
            self._noise_rows.addcmul_(self._lasting[i][k], Y[i], value=-1)
        Z = _summed([(column, gain[k]) for column, gain in zip(self._columns, self._gains_across, strict=True)])
        self._value_columns.sub_(Z)
        for i in signals:
            self._noise_columns.addcmul_(Z[:, i, None], self._across[i][k], value=-1)
        observed = self._observed[k]
        state.values[:, :-1] += observed
        for i in signals:
            self._noise_rows[:, :-1].addcmul_(self._lasting[i][k], observed[i])


def _forward_substituted(eliminated: Tensor, measured: Measurements, size: int) -> Tensor:
    """L⁻¹ H of all steps, zero where nothing was measured."""
    signals = eliminated.shape[1]
    H = eliminated.new_zeros(len(eliminated), signals, signals * size, eliminated.shape[-1])
    H[:, :, ::size] = torch.eye(signals).to(H)[..., None]
    H[:, :, size - 1 :: size] = measured.lasting
    H *= measured.valid[:, None, None]
    for i in range(signals):
        for j in range(i + 1, signals):
            H[:, j].addcmul_(H[:, i], (eliminated[:, j, i] / eliminated[:, i, i])[:, None], value=-1)
    return H


def _solved(eliminated: Tensor, right: Tensor) -> Tensor:
    """S⁻¹ of something, L⁻¹ of which is given, at all steps."""
    solved, signals = right.clone(), right.shape[1]
    for i in reversed(range(signals)):
        for j in range(i + 1, signals):
            solved[:, i].addcmul_(eliminated[:, i, j, None], solved[:, j], value=-1)
        solved[:, i] /= eliminated[:, i, i, None]
    return solved
