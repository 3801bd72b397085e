"""Gains of columns from an archive: what stays in its column is gain, what wanders sideways with the object is not.

With the logarithm of the codes on lines whose object is displaced by s columns,

    log I(u, s) = λ(u) + ρ(u - s) + texture,

the mean over lines of one s leaves the gain λ and the object's own pattern ρ across its travel. Both are found by least
squares; streaks along an object end somewhere, so that ρ is one within a short segment of the travel only. Of a wave of
k radians a column, the wander separates the share

    1 - |φ(k)|²,     φ(k) = mean of exp(-i k s),

of the information that a uniform object would give: without wander nothing, and of waves much longer than the wander
next to nothing: vignetting looks like a shaded object. So only waves up to ``observed_px`` are stated.
"""

import math
from dataclasses import dataclass, field, fields, replace

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD

_BIN_PX = 0.5  # of wander, whose lines are averaged
_LEAST_SHARE = 0.1  # of the information, that counts as observed
_ROUNDS, _SETTLED = 60, 1e-14  # of conjugate gradients; of the first residual, squared
_ALIKE = 0.002  # of a gain: what patterns between two columns and bins leave in both halves, on drawn streaks and edges
_GROUPED = 4  # neighbouring segments that fall to one half of the lines: streaks reach over some
_FEWEST = 4  # bins that must have a column
_LONGEST_PX = 4096


@dataclass
class WanderSums:
    """Sums of logarithms of codes by segment of the travel and wander.

    The pattern of the object may change from segment to segment. Halves of the segments show the errors.
    """

    _parts: list["_Means"] = field(default_factory=list, init=False, repr=False)

    def add(
        self,
        codes: Shaped[Tensor, "lines width channels"],
        seen: Bool[Tensor, "lines width"],
        wander_px: Float[Tensor, " lines"],
        segment: int,
    ) -> None:
        """Add lines of a segment.

        Args:
            codes: over the dark. seen: samples that show the object. wander_px: of each line, from any zero.
            segment: its number; the pattern of the object is one within it.
        """
        known = seen & (codes > 0).all(-1)
        logs = codes.double().clamp(min=1e-3).log() * known[..., None]
        place, line = (wander_px / _BIN_PX).round().long().unique(return_inverse=True)
        count = torch.zeros(len(place), known.shape[1], dtype=torch.float64).index_add_(0, line, known.double())
        sums = torch.zeros(*count.shape, codes.shape[-1], dtype=torch.float64).index_add_(0, line, logs)
        mean = sums / count.clamp(min=1)[..., None]
        self._parts.append(_Means(mean, count, place * _BIN_PX, torch.full_like(place, segment)))

    def gains(self) -> "WanderGains":
        """The gains that the lines show, and how well."""
        whole = _Means.joined(self._parts)
        halves = [[part for part in self._parts if int(part.segment[0]) // _GROUPED % 2 == half] for half in (0, 1)]
        log_gain = _without_long(_solve(whole), whole.observed_px)
        halved = torch.full_like(log_gain, torch.inf)
        if all(halves):
            one, other = (_without_long(_solve(_Means.joined(half)), whole.observed_px) for half in halves)
            halved = (one - other).abs() / 2
        return WanderGains(log_gain, halved, whole.observed_px, whole.wander_rms)


@dataclass(frozen=True)
class _Means:
    """Means of logarithms by bin and column, their weights, and the wander, px, and segment of each bin."""

    mean: Float[Tensor, "bins width channels"]
    weight: Float[Tensor, "bins width"]
    place: Float[Tensor, " bins"]
    segment: Int[Tensor, " bins"]

    @classmethod
    def joined(cls, parts: list["_Means"]) -> "_Means":
        """Those of several segments, which are numbered anew from 0 on."""
        whole = cls(*(torch.cat([getattr(part, item.name) for part in parts]) for item in fields(cls)))
        return replace(whole, segment=whole.segment.unique(return_inverse=True)[1])

    @property
    def wander_rms(self) -> float:
        """Rms of the wander within segments, px."""
        lines = self.weight.double().sum(1)
        total, moment = (self._by_segment(values) for values in (lines, lines * self.place))
        off = self.place - (moment / total.clamp(min=1e-9))[self.segment]
        return float((lines * off.square()).sum().div(lines.sum().clamp(min=1e-9)).sqrt())

    @property
    def observed_px(self) -> float:
        """Longest wave, columns, of which the wander leaves a tenth of the information; 0 where there is none."""
        lines = self.weight.double().sum(1)
        if float(lines.sum()) == 0:
            return 0.0
        waves = torch.logspace(math.log10(2.0), math.log10(_LONGEST_PX), 400, dtype=torch.float64)
        turn = torch.exp(2j * math.pi / waves * self.place[:, None]) * lines[:, None]
        total = self._by_segment(lines).clamp(min=1e-9)
        hidden = (self._by_segment(turn).abs().square() / total[:, None]).sum(0) / lines.sum()
        blind = (1 - hidden < _LEAST_SHARE).nonzero()[:, 0]
        if not len(blind):
            return float(waves[-1])
        return float(waves[int(blind[0]) - 1]) if int(blind[0]) else 0.0

    def without_pattern(self, values: Float[Tensor, "bins width channels"]) -> Tensor:
        """Values less the pattern of the object that fits them best in each segment."""
        margin = int(self.place.abs().max()) + 2
        pad = (margin, margin)
        summed = self._by_segment(_shifted(F.pad((values * self.weight[..., None]).mT, pad).mT, self.place))
        known = self._by_segment(_shifted(F.pad(self.weight, pad)[..., None], self.place))
        pattern = summed / known.clamp(min=1e-9)
        back = _shifted(pattern[self.segment], -self.place)
        return values - back[:, margin : margin + values.shape[1]]

    def right_side(self, values: Float[Tensor, "bins width channels"]) -> Tensor:
        """Sum over the bins of what no pattern explains."""
        return (self.weight[..., None] * self.without_pattern(values)).sum(0).double()

    def applied(self, gain: Float[Tensor, "width channels"]) -> Tensor:
        """The normal equations' matrix times gains."""
        return self.right_side(gain.expand(len(self.place), -1, -1).to(self.mean))

    def _by_segment(self, values: Tensor) -> Tensor:
        """Sums over the bins of each segment."""
        total = values.new_zeros(int(self.segment.max()) + 1, *values.shape[1:])
        return total.index_add_(0, self.segment, values)


@dataclass(frozen=True)
class WanderGains:
    """Logarithms of the gains of columns without waves longer than ``observed_px``; NaN where too little was seen.

    Attributes:
        halved: half of the absolute difference between those of two halves of the lines.
        observed_px: longest wave that the wander separates from the object; 0 where it separates none.
        wander_px: rms of the wander within segments.
    """

    log_gain: Float[Tensor, "width channels"]
    halved: Float[Tensor, "width channels"]
    observed_px: float
    wander_px: float

    @property
    def sigma(self) -> float:
        """The usual standard deviation of a gain, relative, by the two halves, and what both err by alike."""
        return math.hypot(NORMAL_OVER_MAD * float(self.halved.nanmedian()), _ALIKE)


def _solve(means: _Means) -> Float[Tensor, "width channels"]:
    """The gains' logarithms by least squares, the object's pattern eliminated; NaN where seen at too few places."""
    gain = _conjugate_gradients(means, means.right_side(means.mean))
    seen = (means.weight > 0).sum(0) >= _FEWEST
    return gain.masked_fill(~seen[:, None], torch.nan)


def _conjugate_gradients(equations: _Means, right: Tensor) -> Tensor:
    """Solve the normal equations, each colour by itself, as far as a few rounds go: what is observed settles first."""
    inverse = 1 / equations.weight.double().sum(0).clamp(min=1.0)[:, None]
    gain, left = torch.zeros_like(right), right
    step = inverse * left
    size = first = (left * step).sum(0)
    for _ in range(_ROUNDS):
        applied = equations.applied(step)
        bend = (step * applied).sum(0)
        settled = (size <= _SETTLED * first) | (bend <= 0)
        if bool(settled.all()):
            break
        length = torch.where(settled, 0.0, size / bend.clamp(min=torch.finfo(bend.dtype).tiny))
        gain, left = gain + length * step, left - length * applied
        after = (left * inverse * left).sum(0)
        step, size = inverse * left + torch.where(settled, 0.0, after / size.clamp(min=1e-300)) * step, after
    return gain


def _shifted(values: Float[Tensor, "bins width channels"], by: Float[Tensor, " bins"]) -> Tensor:
    """Values of every bin at columns u + by, linear between columns; those at the ends come round."""
    first = by.floor()
    share = (by - first)[:, None, None].to(values)
    columns = torch.arange(values.shape[1])[None] + first.long()[:, None]
    here, after = (
        values.gather(1, (columns + step).remainder(values.shape[1])[..., None].expand_as(values)) for step in (0, 1)
    )
    return torch.lerp(here, after, share)


def _without_long(log_gain: Tensor, longest_px: float) -> Tensor:
    """What is left of gains without waves longer than a given one: less their mean over that many columns."""
    reach = max(1, round(longest_px / 2))
    seen = ~log_gain.isnan()
    kernel = torch.ones(1, 1, 2 * reach + 1, dtype=log_gain.dtype)
    known, total = (
        F.conv1d(part.T[:, None], kernel, padding=reach)[:, 0].T for part in (seen.to(log_gain), log_gain.nan_to_num())
    )
    return log_gain - total / known.clamp(min=1)
