"""Rauch-Tung-Striebel cubature smoother in square-root form.

Backwards from the last filtered state, with the moments of the transition f over the filtered Gaussian N(m, L Lᵀ):

    [odd_f  even_f  √Q]              [√P⁻  0]
    [  L      0      0]  rotated to  [ G   X],   gain C = G √P⁻⁻¹,   P_s = C P_s⁺ Cᵀ + X Xᵀ.

Source: Särkkä & Svensson 2023, Bayesian Filtering and Smoothing, ch. 14; Arasaratnam & Haykin 2011 (square root).
"""

import torch
from torch import Tensor

from lsvision.estimation.cubature import Function, sigma_moments
from lsvision.estimation.filtering import StateSpace, Track
from lsvision.estimation.gaussian import BatchLast, Gaussian
from lsvision.estimation.linalg import absorb, forward_substitute, ordered_sum


def smooth(track: Track, model: StateSpace) -> Gaussian:
    """All states given all measurements, ``(steps, *batch)``.

    Args:
        track: of ``filter_sequence`` with its history, and the model it was filtered with.

    Raises:
        ValueError: the track was made without its history.
    """
    if len(track.factors) != len(track.means):
        raise ValueError(f"track must hold a factor for each of {len(track.means)} steps, has {len(track.factors)}")
    process = model.process_chol.expand_as(track.factors).movedim((-2, -1), (1, 2))
    means, factors = track.means.movedim(-1, 1), track.factors.movedim((-2, -1), (1, 2))
    filtered = [BatchLast(*moments) for moments in zip(means, factors, strict=True)]
    smoothed = [filtered[-1]]
    for k in reversed(range(len(filtered) - 1)):
        smoothed.append(_step_back(model.f, filtered[k], smoothed[-1], process[k + 1]))
    return Gaussian(
        torch.stack([state.mean for state in reversed(smoothed)]).movedim(1, -1),
        torch.stack([state.factor for state in reversed(smoothed)]).movedim((1, 2), (-2, -1)),
    )


def _step_back(f: Function | None, filtered: BatchLast, following: BatchLast, process: Tensor) -> BatchLast:
    """Smoothed state from the filtered one and the smoothed one that follows it; ``process`` is √Q between them."""
    mean, factor = filtered.mean, filtered.factor
    if f is None:
        predicted, moved, still = mean, factor, factor
    else:
        moments = sigma_moments(f, mean, factor)
        predicted, moved = moments.center, moments.factor
        still = torch.cat([factor, torch.zeros_like(moments.even)], dim=1)
    root, remainder = absorb(process, moved, still)
    size = len(mean)
    correction = torch.cat([(following.mean - predicted)[:, None], following.factor], dim=1)
    whitened = forward_substitute(root[:size], correction)
    gained = ordered_sum(root[size:, :, None] * whitened)[:, 0]
    smoothed_factor, _ = absorb(torch.zeros_like(process), torch.cat([gained[:, 1:], remainder], dim=1))
    return BatchLast(mean + gained[:, 0], smoothed_factor)
