"""Whether a quantity that is measured again and again has changed: a self-starting CUSUM.

Neither mean nor standard deviation is known beforehand. Each value is compared with the mean and the standard deviation
of those before it,

    T_t = sqrt((t-1)/t) (x_t - m_{t-1}) / s_{t-1},

which is Student's t with t - 2 degrees of freedom and independent from value to value, and turned into a normal score
U_t. Two sums collect what the scores exceed the allowance k by, S± = max(0, S± ± U - k). A score counts no more than
``MOST_SCORE``: a single odd value is no change.

Where a sum exceeds its limit, the change is taken to lie where it is most likely.

Source: Hawkins 1987, Self-starting CUSUM charts for location and scale; Wallace 1959 for the normal score of t.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

MOST_SCORE = 3.0
_WINSORISED = 3.0  # standard deviations beyond which a value does not pull at the mean that later ones are judged by


@dataclass(frozen=True)
class ControlChart:
    """The sums of a self-starting CUSUM after every value."""

    upper: Float[Tensor, "*batch values"]
    lower: Float[Tensor, "*batch values"]

    @property
    def highest(self) -> Float[Tensor, "*batch values"]:
        """The larger of both."""
        return torch.maximum(self.upper, self.lower)


@dataclass(frozen=True)
class Change:
    """A change between two values.

    Attributes:
        first: index of the first value after it. noticed: that of the value with which it was noticed.
        size: mean after it, up to ``noticed``, less the mean before it.
    """

    first: int
    noticed: int
    size: float


def control_chart(
    values: Float[Tensor, "*batch values"], learned: int, allowance: float, least_sigma: float = 0.0
) -> ControlChart:
    """Sums of a self-starting CUSUM.

    Args:
        values: in order of time.
        learned: values that are not judged, 2 or more.
        allowance: k, standard deviations.
        least_sigma: of a value: those that agree better by chance are not trusted.
    """
    if learned < 2:
        raise ValueError(f"learned: expected at least 2 values, got {learned}")
    upper, lower = torch.zeros_like(values), torch.zeros_like(values)
    up = down = values.new_zeros(values.shape[:-1])
    mean, squares = values[..., :learned].mean(-1), values.new_zeros(values.shape[:-1])
    if values.shape[-1] > learned:
        squares = values[..., :learned].var(-1) * (learned - 1)
    for count in range(learned, values.shape[-1]):
        sigma = (squares / (count - 1)).sqrt().clamp(min=max(least_sigma, torch.finfo(values.dtype).tiny))
        off = (values[..., count] - mean) / sigma
        score = normal_score(off * (count / (count + 1)) ** 0.5, count - 1).clamp(-MOST_SCORE, MOST_SCORE)
        up, down = (up + score - allowance).clamp(min=0), (down - score - allowance).clamp(min=0)
        upper[..., count], lower[..., count] = up, down
        step = off.clamp(-_WINSORISED, _WINSORISED) * sigma
        squares = squares + step.square() * (count / (count + 1))
        mean = mean + step / (count + 1)
    return ControlChart(upper, lower)


def normal_score(t: Float[Tensor, "*batch"], degrees: int) -> Float[Tensor, "*batch"]:
    """The value of a standard normal distribution that is exceeded as often as one of Student's t.

    Args:
        degrees: of freedom of t.
    """
    scale = (8 * degrees + 1) / (8 * degrees + 3)
    return t.sign() * scale * (degrees * torch.log1p(t.square() / degrees)).sqrt()


@dataclass(frozen=True)
class ChangeRule:
    """When a chart shows a change.

    Attributes:
        learned, allowance, least_sigma: as of ``control_chart``.
        limit: h, which a sum has to exceed.
        least_size: of a change; a smaller one is none, however significant.
    """

    learned: int = 8
    allowance: float = 1.0
    limit: float = 4.8
    least_sigma: float = 0.0
    least_size: float = 0.0


def changes(values: Float[Tensor, " values"], rule: ChangeRule) -> list[Change]:
    """All changes of a quantity in order: what follows one is judged afresh."""
    found: list[Change] = []
    start = 0
    while (change := _first_change(values[start:], rule)) is not None:
        found.append(Change(start + change.first, start + change.noticed, change.size))
        start += change.first
    return found


def _first_change(values: Float[Tensor, " values"], rule: ChangeRule) -> Change | None:
    """The first change, where the values up to its alarm are most likely to have changed."""
    chart = control_chart(values, rule.learned, rule.allowance, rule.least_sigma)
    for noticed in (chart.highest > rule.limit).nonzero()[:, 0].tolist():
        change = _most_likely(values[: noticed + 1], rule.learned)
        if abs(change.size) >= rule.least_size:
            return change
    return None


def _most_likely(values: Float[Tensor, " values"], learned: int) -> Change:
    """The change of the mean of some values that is most likely, of those after the first ones.

    Source: Hinkley 1970, Inference about the change-point in a sequence of random variables.
    """
    count, last = len(values), len(values) - 1
    before = torch.arange(learned, count, dtype=values.dtype)
    sums = values.cumsum(0)
    apart = (sums[-1] - sums[learned - 1 : last]) / (count - before) - sums[learned - 1 : last] / before
    best = int((apart.square() * before * (count - before)).argmax())
    return Change(learned + best, last, float(apart[best]))
