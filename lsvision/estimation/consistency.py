"""Whether an estimator's errors are as large as its sigmas state: normalised squares against chi-square bands.

Source: Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4.
"""

import math

import torch
from jaxtyping import Float, Real
from torch import Tensor

from lsvision.estimation.linalg import lower_factor, solve_upper


def nees(
    error: Float[Tensor, "*batch state"], factor: Float[Tensor, "*batch state columns"]
) -> Float[Tensor, "*batch"]:
    """Normalised estimation error squared, eᵀ P⁻¹ e with P = factor factorᵀ; on average the size of the state."""
    lower = lower_factor(factor)
    whitened = solve_upper(lower.flip(-2, -1), error.flip(-1)[..., None])
    return whitened.square().sum((-2, -1))


def nis(whitened_innovation: Float[Tensor, "*batch measurement"]) -> Float[Tensor, "*batch"]:
    """Library API: normalised innovation squared; on average the size of the measurement."""
    return whitened_innovation.square().sum(-1)


def chi_square_tail(
    value: Float[Tensor, "*#batch"], freedom: Real[Tensor, "*#batch"] | float
) -> Float[Tensor, "*batch"]:
    """Probability that a chi-square variable of so many degrees of freedom is larger than a value."""
    half = torch.as_tensor(freedom, dtype=value.dtype, device=value.device) / 2
    return torch.special.gammaincc(*torch.broadcast_tensors(half, value / 2))


def mean_chi_square_band(freedom: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval that holds the mean of ``runs`` chi-square values of ``freedom`` degrees with a probability."""
    total = freedom * runs
    tail = (1 - probability) / 2
    return _chi_square_quantile(tail, total) / runs, _chi_square_quantile(1 - tail, total) / runs


def _chi_square_quantile(probability: float, freedom: int) -> float:
    """The value below which a chi-square variable lies with a probability, by bisection of its distribution."""
    low, high = 0.0, freedom + 20 * math.sqrt(2 * freedom) + 50
    while high - low > 1e-10 * high:
        middle = (low + high) / 2
        below = chi_square_tail(torch.tensor(middle, dtype=torch.float64), float(freedom)) > 1 - probability
        low, high = (middle, high) if bool(below) else (low, middle)
    return (low + high) / 2
