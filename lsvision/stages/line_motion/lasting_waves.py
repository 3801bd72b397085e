"""Waves that the motion of a scan consists of, and by how much they drift over the object.

Over an object that is as short as its waves are long, a motion without mean and trend is not the motion: a sine has a
trend over a part of its length. Edges of an object do not show that trend, which looks like their own direction. The
waves do, where all that was measured is a few of them: a wave is a sine of the same frequency in all components, as
those of a machine are, and a straight line is none. Frequencies come from what is known best, δz as a rule.

Where anything but waves is left, as of a motion at random, nothing is said of the trend.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_MOST_WAVES, _FEWEST_LINES, _MOST_LINES = 4, 64, 600
_LONGEST, _SHORTEST, _APART, _STEP = 0.4, 40.0, 0.5, 0.1  # waves over the object; between two; of the search
_SEEN = 0.8  # of the longest wave, at least, over the object
_TRIED = 3  # of the best frequencies for one wave more
_STEPS, _SETTLED = 30, 1e-8
_LEAST_GAIN = 12.0  # of the logarithm of the likelihood, for one wave more
_MOST_LEFT = 2.0  # mean square of what is left over its variance, of each component
_FLOOR = 0.3  # of the usual sigma of the least known component: none is that much surer
_LASTING = 0.3  # of the usual sigma of a line, by which an edge may be bent or askew all along
_PARTS, _SLOW = 10, 4  # of the object, over which slow errors are summed; what the fit takes of them


@dataclass(frozen=True)
class WaveTrend:
    """Trend of each component over the object, per mm, its variance, and how many waves make it."""

    slope: Float[Tensor, " components"]
    variance: Float[Tensor, " components"]
    waves: int


def trend_of_waves(
    along_mm: Float[Tensor, " lines"],
    values: Float[Tensor, "lines components"],
    sigma: Float[Tensor, "lines components"],
    memory: float,
    used: Bool[Tensor, " lines"],
) -> WaveTrend | None:
    """The trend of waves that were measured but for their mean and trend; None where they are no waves.

    Args:
        along_mm: travel of the lines. sigma: of the values. memory: lines over which their errors are alike.
        used: lines that show the object.
    """
    stride = max(1, int(used.sum()) // _MOST_LINES)
    chosen = used.nonzero()[::stride, 0]
    if len(chosen) < _FEWEST_LINES or not bool(sigma[chosen].max() > 0):
        return None
    place = along_mm[chosen] - along_mm[chosen].mean()
    length = float(place.max() - place.min())
    alike = max(1.0, (1 + 2 * memory) / stride)  # lines that err together
    usual = sigma[chosen].median(0).values
    weight = 1 / (sigma[chosen].maximum(_FLOOR * usual.max()) * math.sqrt(alike))
    limit = _MOST_LEFT / alike
    fit = _Fit.of(place, values[chosen], weight, place.new_zeros(0))
    while fit.waves < _MOST_WAVES:
        more = _with_one_more(fit, length)
        if more is None or fit.left - more.left < 2 * _LEAST_GAIN:
            break
        fit = more
    # A piece of a longer wave may have any trend.
    if fit.waves == 0 or float(fit.frequency.min()) * length < _SEEN or bool((fit.mean_square > limit).any()):
        return None
    trend = fit.trend()
    # Errors that last all along, as of an edge that is bent, are of the size of those of single lines.
    return replace(trend, variance=trend.variance + (_LASTING * usual).square() / place.square().mean())


@dataclass(frozen=True)
class _Fit:
    """Waves of given frequencies and a straight line, by least squares for each component.

    ``coefficients`` are those of one, the place, the cosines and the sines; ``residual`` is in standard deviations.
    """

    place: Float[Tensor, " lines"]
    values: Float[Tensor, "lines components"]
    weight: Float[Tensor, "lines components"]
    frequency: Float[Tensor, " waves"]
    coefficients: Float[Tensor, "components columns"]
    residual: Float[Tensor, "components lines"]

    @classmethod
    def of(cls, place: Tensor, values: Tensor, weight: Tensor, frequency: Tensor) -> "_Fit":
        """Of some frequencies."""
        rows = weight.T[..., None] * _design(place, frequency)
        right = (weight * values).T[..., None]
        found = torch.linalg.lstsq(rows, right).solution
        return cls(place, values, weight, frequency, found[..., 0], (right - rows @ found)[..., 0])

    def at(self, frequency: Float[Tensor, " waves"]) -> "_Fit":
        """With other frequencies."""
        return _Fit.of(self.place, self.values, self.weight, frequency)

    @property
    def waves(self) -> int:
        """Number of waves."""
        return len(self.frequency)

    @property
    def left(self) -> float:
        """Sum of the squares of what is left."""
        return float(self.residual.square().sum())

    @property
    def mean_square(self) -> Float[Tensor, " components"]:
        """Of what is left of each component."""
        return self.residual.square().mean(1)

    @property
    def slow_square(self) -> Float[Tensor, " components"]:
        """Of sums over tenths of the object, by how many lines they hold: errors that last longer than is stated."""
        tenth = self.residual.shape[1] // _PARTS
        sums = self.residual[:, : _PARTS * tenth].unflatten(1, (_PARTS, tenth)).sum(-1)
        return sums.square().sum(1) / tenth / (_PARTS - _SLOW)

    @property
    def by_frequency(self) -> Float[Tensor, "components lines waves"]:
        """Derivatives of the waves by their frequencies, in standard deviations."""
        turn, swing = 2 * math.pi * self.place[:, None], _angle(self.place, self.frequency)
        cosine, sine = self.coefficients[:, None, 2:].chunk(2, -1)
        return self.weight.T[..., None] * turn * (sine * torch.cos(swing) - cosine * torch.sin(swing))

    @property
    def jacobian(self) -> Float[Tensor, "rows columns"]:
        """By the coefficients of every component, and the frequencies that all share."""
        each = self.weight.T[..., None] * _design(self.place, self.frequency)
        return torch.cat([torch.block_diag(*each), self.by_frequency.flatten(0, 1)], 1)

    def refined(self) -> "_Fit":
        """With the frequencies that leave least nearby: Levenberg and Marquardt's steps."""
        fit, damping = self, 1e-3
        for _ in range(_STEPS):
            rows = fit.jacobian
            normal = rows.T @ rows
            step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal()), rows.T @ fit.residual.flatten())
            tried = fit.frequency + step[-fit.waves :]
            better = fit.at(tried) if bool((tried > 0).all()) else fit
            if better.left >= fit.left:
                damping *= 6
                continue
            settled = fit.left - better.left < _SETTLED * fit.left
            fit, damping = better, max(damping / 5, 1e-9)
            if settled:
                break
        return fit

    def trend(self) -> WaveTrend:
        """Of the waves: what was measured has none, so that it is the line's, the other way round."""
        rows, columns = self.jacobian, self.coefficients.shape[1]
        covariance = torch.linalg.pinv(rows.T @ rows, hermitian=True)
        index = torch.arange(len(self.coefficients)) * columns + 1
        excess = torch.maximum(self.mean_square, self.slow_square).clamp(min=1.0)
        return WaveTrend(-self.coefficients[:, 1], covariance.diagonal()[index] * excess, self.waves)


def _with_one_more(fit: _Fit, length: float) -> _Fit | None:
    """The best fit with one wave more; None where no frequency is left."""
    frequency = torch.arange(_LONGEST, _SHORTEST, _STEP).double() / length
    taken = (frequency[:, None] - fit.frequency).abs() < _APART / length
    frequency = frequency[~taken.any(1)]
    if not len(frequency):
        return None
    gain = torch.stack([_explained(fit, one) for one in frequency])
    best = frequency[gain.argsort(descending=True)[:_TRIED]]
    return min((fit.at(torch.cat([fit.frequency, one[None]])).refined() for one in best), key=lambda each: each.left)


def _explained(fit: _Fit, frequency: Tensor) -> Tensor:
    """How much of what is left a wave of a frequency would explain, had the others not to change."""
    swing = _angle(fit.place, frequency[None])
    rows = fit.weight.T[..., None] * torch.cat([torch.cos(swing), torch.sin(swing)], 1)
    right = rows.mT @ fit.residual[..., None]
    return (right * torch.linalg.solve(rows.mT @ rows + 1e-9 * torch.eye(2).to(rows), right)).sum()


def _design(place: Tensor, frequency: Tensor) -> Float[Tensor, "lines columns"]:
    swing = _angle(place, frequency)
    return torch.cat([torch.ones_like(place)[:, None], place[:, None], torch.cos(swing), torch.sin(swing)], 1)


def _angle(place: Tensor, frequency: Tensor) -> Float[Tensor, "lines waves"]:
    return 2 * math.pi * place[:, None] * frequency
