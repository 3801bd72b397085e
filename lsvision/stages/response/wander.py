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
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.stages.response.gain_equations import GainEquations

_BIN_PX = 0.5  # of wander, whose lines are averaged
_LEAST_SHARE = 0.1  # of the information, that counts as observed
_ALIKE = 0.002  # of a gain: what patterns between two columns and bins leave in both halves, on drawn streaks and edges
_GROUPED = 4  # neighbouring segments that fall to one half of the lines: streaks reach over some
_WAVES = torch.logspace(math.log10(2.0), math.log10(4096), 400, dtype=torch.float64)  # columns


@dataclass
class WanderSums:
    """Normal equations of the gains, summed segment by segment of the travel; halves of these show the errors.

    The pattern of the object may change from segment to segment.
    """

    _segment: int = field(default=0, init=False)
    _open: list["_Bins"] = field(default_factory=list, init=False, repr=False)
    _halves: dict[int, GainEquations] = field(default_factory=dict, init=False, repr=False)
    _spread: "_Spread" = field(default_factory=lambda: _Spread(), init=False, repr=False)

    def add(
        self,
        codes: Shaped[Tensor, "lines width channels"],
        seen: Bool[Tensor, "lines width"],
        wander_px: Float[Tensor, " lines"],
        segment: int,
    ) -> None:
        """Add lines of a segment, those of one segment after the other.

        Args:
            codes: over the dark. seen: samples that show the object. wander_px: of each line, from any zero.
            segment: its number; the pattern of the object is one within it.
        """
        if segment != self._segment:
            self._close()
            self._segment = segment
        self._open.append(_Bins.of(codes, seen, wander_px))

    def gains(self) -> "WanderGains":
        """The gains that the lines show, and how well; of one line at least."""
        self._close()
        observed_px, halves = self._spread.observed_px, list(self._halves.values())
        log_gain = _without_long((halves[0] + halves[1] if len(halves) > 1 else halves[0]).solved(), observed_px)
        halved = torch.full_like(log_gain, torch.inf)
        if len(halves) > 1:
            one, other = (_without_long(half.solved(), observed_px) for half in halves)
            halved = (one - other).abs() / 2
        return WanderGains(log_gain, halved, observed_px, self._spread.wander_rms)

    def _close(self) -> None:
        """Sum up the segment whose lines were added."""
        if not self._open:
            return
        bins = _Bins.joined(self._open)
        self._open.clear()
        self._spread.add(bins)
        equations = GainEquations.of_segment(bins.sums, bins.weight, bins.place_px)
        half = self._segment // _GROUPED % 2
        self._halves[half] = self._halves[half] + equations if half in self._halves else equations


@dataclass(frozen=True)
class _Bins:
    """Sums of logarithms of one segment by wander and column, and how many samples they are of."""

    number: Int[Tensor, " bins"]
    sums: Float[Tensor, "bins width channels"]
    weight: Float[Tensor, "bins width"]

    @classmethod
    def of(
        cls, codes: Shaped[Tensor, "lines width channels"], seen: Bool[Tensor, "lines width"], wander_px: Tensor
    ) -> "_Bins":
        """Those of some lines."""
        known = (seen & (codes > 0).all(-1)).double()
        logs = codes.double().clamp(min=1e-3).log() * known[..., None]
        return cls((wander_px / _BIN_PX).round().long(), logs, known)._summed()

    @classmethod
    def joined(cls, parts: list["_Bins"]) -> "_Bins":
        """Those of all lines of several."""
        number, sums, weight = (torch.cat([getattr(part, name) for part in parts]) for name in cls.__annotations__)
        return cls(number, sums, weight)._summed()

    @property
    def place_px(self) -> Float[Tensor, " bins"]:
        """Wander of each bin."""
        return self.number.double() * _BIN_PX

    def _summed(self) -> "_Bins":
        """With one bin of each number."""
        number, bin_of = self.number.unique(return_inverse=True)
        sums, weight = (
            values.new_zeros(len(number), *values.shape[1:]).index_add_(0, bin_of, values)
            for values in (self.sums, self.weight)
        )
        return _Bins(number, sums, weight)


@dataclass
class _Spread:
    """How far the object wanders within segments: sums over these, each by its number of samples."""

    samples: float = 0.0
    squares: float = 0.0
    hidden: Float[Tensor, " waves"] = field(default_factory=lambda: torch.zeros_like(_WAVES))

    def add(self, bins: _Bins) -> None:
        """Add a segment."""
        count, place = bins.weight.sum(1), bins.place_px
        total = float(count.sum())
        if total == 0:
            return
        off = place - (count * place).sum() / total
        turn = (torch.exp(2j * math.pi / _WAVES * off[:, None]) * count[:, None]).sum(0)
        self.samples += total
        self.squares += float((count * off.square()).sum())
        self.hidden = self.hidden + turn.abs().square() / total

    @property
    def wander_rms(self) -> float:
        """Rms of the wander within segments, px."""
        return math.sqrt(self.squares / max(self.samples, 1.0))

    @property
    def observed_px(self) -> float:
        """Longest wave, columns, of which the wander leaves a tenth of the information; 0 where there is none."""
        if self.samples == 0:
            return 0.0
        blind = (1 - self.hidden / self.samples < _LEAST_SHARE).nonzero()[:, 0]
        if not len(blind):
            return float(_WAVES[-1])
        return float(_WAVES[int(blind[0]) - 1]) if int(blind[0]) else 0.0


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


def _without_long(log_gain: Tensor, longest_px: float) -> Tensor:
    """What is left of gains without waves longer than a given one: less their mean over that many columns."""
    reach = max(1, round(longest_px / 2))
    seen = ~log_gain.isnan()
    kernel = torch.ones(1, 1, 2 * reach + 1, dtype=log_gain.dtype)
    known, total = (
        F.conv1d(part.T[:, None], kernel, padding=reach)[:, 0].T for part in (seen.to(log_gain), log_gain.nan_to_num())
    )
    return log_gain - total / known.clamp(min=1)
