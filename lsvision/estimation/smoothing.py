"""Rauch-Tung-Striebel cubature smoother in square-root form.

Backwards from the last filtered state, with the moments of the transition f over the filtered Gaussian N(m, L Lᵀ):

    [odd_f  even_f  √Q]              [√P⁻  0]
    [  L      0      0]  rotated to  [ G   X],   gain C = G √P⁻⁻¹,   P_s = C P_s⁺ Cᵀ + X Xᵀ.

Source: Särkkä & Svensson 2023, Bayesian Filtering and Smoothing, ch. 14; Arasaratnam & Haykin 2011 (square root).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.cubature import Function, sigma_moments
from lsvision.estimation.filtering import Track
from lsvision.estimation.square_root import absorb, forward_substitute, ordered_sum


def smooth(
    track: Track, process_chol: Float[Tensor, "*#batch state state"], f: Function | None = None
) -> tuple[Float[Tensor, "steps *batch state"], Float[Tensor, "steps *batch state state"]]:
    """Means and covariance factors of all states given all measurements.

    Args:
        track: of ``filter_sequence`` with its history, and the same ``process_chol`` and ``f``.

    Raises:
        ValueError: the track was made without its history.
    """
    if len(track.factors) != len(track.means):
        raise ValueError(f"track must hold a factor for each of {len(track.means)} steps, has {len(track.factors)}")
    process = process_chol.expand_as(track.factors[0]).movedim((-2, -1), (0, 1))
    means, factors = track.means.movedim(-1, 1), track.factors.movedim((-2, -1), (1, 2))
    smoothed = [(means[-1], factors[-1])]
    for mean, factor in zip(means[:-1].flip(0), factors[:-1].flip(0), strict=True):
        smoothed.append(_step_back(f, mean, factor, process, *smoothed[-1]))
    smoothed_means, smoothed_factors = (torch.stack(part[::-1]) for part in zip(*smoothed, strict=True))
    return smoothed_means.movedim(1, -1), smoothed_factors.movedim((1, 2), (-2, -1))


def _step_back(
    f: Function | None, mean: Tensor, factor: Tensor, process: Tensor, next_mean: Tensor, next_factor: Tensor
) -> tuple[Tensor, Tensor]:
    """Smoothed mean and factor of one state from those of the next; batch last."""
    if f is None:
        predicted, deviations, own = mean, factor, factor
    else:
        predicted, odd, even = sigma_moments(f, mean, factor)
        deviations, own = torch.cat([odd, even], dim=1), torch.cat([factor, torch.zeros_like(even)], dim=1)
    root, remainder = absorb(process, deviations, own)
    size = len(mean)
    whitened = forward_substitute(root[:size], torch.cat([(next_mean - predicted)[:, None], next_factor], dim=1))
    gained = ordered_sum(root[size:, :, None] * whitened)[:, 0]
    smoothed_factor, _ = absorb(torch.zeros_like(process), torch.cat([gained[:, 1:], remainder], dim=1))
    return mean + gained[:, 0], smoothed_factor
