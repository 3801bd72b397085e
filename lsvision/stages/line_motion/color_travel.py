"""How far the object advances from line to line, from its texture: no target is needed.

Two colours of a trilinear sensor look at planes a known distance apart. What one shows on a row, the other shows some
rows later: distance / advance. In windows along the scan the phase of the cross-spectrum of the two colours, summed
over the columns that show the object, gives that row shift to a small part of a line,

    phase(f) = -2π f ε,     weights γ² / (1 - γ²), γ² the coherence.

``rate`` is the true advance over that which the scan's travel and the calibration's n say. The planes meet in the
camera's centre: what lies a millimetre deeper lags by 0.125 % more, and is turned back in phase beforehand.

Source: Hannan & Thomson 1973, Estimating group delay (weights); Knapp & Carter 1976.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import without_trend
from lsvision.stages.line_motion.color_pair import ColorPair
from lsvision.types import LineFinding, LineMotion

_WINDOW, _HOP = 128, 64  # lines
_BAND = (0.04, 0.3)  # cycles a line: of longer waves a window holds few, shorter ones may be undersampled others
_GROUPS, _PIECE_PX = 8, 16  # of columns, whose scatter shows the errors
_STEPS = 3
_UNSURE = 2e-3  # sigma of the rate of a window that shows too little texture
_LEAST_SHARE = 0.5  # of the windows that must show enough
_OVERLAP = 4 / 3  # variance of a mean of windows that overlap by half, over that of as many independent ones
_STEP_EVIDENCE = 15.0  # by how much a change of the rate must add to the logarithm of the likelihood
_FEWEST = 2  # windows of a piece
_MEDIAN_CHI_SQUARE = 0.4549  # of one degree of freedom


@dataclass(frozen=True)
class TravelPiece:
    """Lines ``first..last`` over which the rate is one, and its standard deviation."""

    first: int
    last: int
    rate: float
    sigma: float


@dataclass(frozen=True)
class ColorTravel:
    """True over assumed advance in windows along the scan, around ``line``; only those with enough texture.

    ``share`` is how many of all windows these are.
    """

    line: Float[Tensor, " windows"]
    rate: Float[Tensor, " windows"]
    sigma: Float[Tensor, " windows"]
    share: float

    @property
    def is_measured(self) -> bool:
        """Whether enough of the scan shows texture."""
        return self.share >= _LEAST_SHARE

    @property
    def whole(self) -> TravelPiece:
        """Mean rate of the scan."""
        return self._piece(0, len(self.line))

    @property
    def pieces(self) -> Sequence[TravelPiece]:
        """The scan cut where the rate changes, by binary segmentation (Scott & Knott 1974)."""
        cuts = [0, *self._cuts(0, len(self.line)), len(self.line)]
        return [self._piece(a, b) for a, b in pairwise(cuts)]

    @property
    def in_words(self) -> str:
        """What was found, for a reader."""
        if not self.is_measured:
            return f"travel: too little texture to measure it, {100 * self.share:.0f} % of the scan show enough"
        whole, pieces = self.whole, self.pieces
        changes = "" if len(pieces) == 1 else f"; it changes {len(pieces) - 1} times"
        return f"travel: {whole.rate:.5f} ± {whole.sigma:.5f} of what its log or pitch and the calibration say{changes}"

    def metadata(self, n2: float) -> dict[str, Any]:
        """The same as plain data.

        Args:
            n2: advance along Y per nominal mm, of the calibration.
        """
        stated: dict[str, Any] = {"measured": self.is_measured, "share": self.share, "in_words": self.in_words}
        if self.is_measured:
            whole = self.whole
            stated |= {"rate": whole.rate, "sigma": whole.sigma, "n2": n2, "n2_measured": n2 * whole.rate}
            stated["pieces"] = [asdict(piece) for piece in self.pieces]
        return stated

    def displacement(self, along_mm: Float[Tensor, " lines"]) -> tuple[Tensor, Tensor]:
        """δy, mm, of every line without mean and trend, and its standard deviation, from the rates of the pieces.

        Args:
            along_mm: travel of the lines as assumed.
        """
        number, gauge = torch.arange(len(along_mm)), without_trend(along_mm)
        total, variance = torch.zeros_like(along_mm), torch.zeros_like(along_mm)
        step = torch.cat([along_mm.new_zeros(1), along_mm.diff()])
        for index, piece in enumerate(pieces := self.pieces):
            first = piece.first if index else 0
            after = pieces[index + 1].first if index + 1 < len(pieces) else len(along_mm)
            within = gauge((step * ((number >= first) & (number < after))).cumsum(0))
            total, variance = total + (piece.rate - 1) * within, variance + (piece.sigma * within).square()
        return total, variance.sqrt()

    def _piece(self, begin: int, end: int) -> TravelPiece:
        weight = self.sigma[begin:end].square().reciprocal()
        rate = float((weight * self.rate[begin:end]).sum() / weight.sum())
        sigma = float((_OVERLAP / weight.sum()).sqrt())
        first, last = (round(float(self.line[i])) for i in (begin, end - 1))
        half = _HOP // 2
        return TravelPiece(max(first - half, 0), last + half, rate, sigma)

    def _cuts(self, begin: int, end: int) -> list[int]:
        """Where to cut the windows ``begin..end-1``."""
        if end - begin < 2 * _FEWEST:
            return []
        weight = self.sigma[begin:end].square().reciprocal() / _OVERLAP
        known, moment = weight.cumsum(0), (weight * self.rate[begin:end]).cumsum(0)
        left, right = known[:-1], known[-1] - known[:-1]
        apart = moment[:-1] / left - (moment[-1] - moment[:-1]) / right
        gain = (left * right / known[-1] * apart.square() / 2)[_FEWEST - 1 : len(left) - _FEWEST + 1]
        if float(gain.max()) < _STEP_EVIDENCE:
            return []
        cut = begin + int(gain.argmax()) + _FEWEST
        return [*self._cuts(begin, cut), cut, *self._cuts(cut, end)]


def with_travel(motion: LineMotion, travel: ColorTravel, along_mm: Float[Tensor, " lines"]) -> LineMotion:
    """The motion with δy where the rate of the advance changes; a constant rate belongs to n.

    Args:
        along_mm: travel of the lines as assumed.
    """
    if not travel.is_measured or len(travel.pieces) == 1:
        return motion
    displacement, sigma = travel.displacement(along_mm)
    values, covariance = motion.values.clone(), motion.covariance.clone()
    values[:, 3], covariance[:, 3, 3] = displacement, sigma.square()
    rms = [float(part.square().mean().sqrt()) for part in (displacement, sigma)]
    return LineMotion(values, covariance, (*motion.findings[:3], LineFinding("dy", "corrected", rms[0], rms[1])))


def measure_color_travel(pair: ColorPair, columns: slice) -> ColorTravel:
    """Rate of the advance of a scan.

    Args:
        columns: that show the object.
    """
    if not (windows := list(_windows(pair, columns))):
        line, rate, sigma = torch.zeros(3, 0, dtype=torch.float64)
        return ColorTravel(line, rate, sigma, 0.0)
    line, lag, shift, information = (torch.stack(part) for part in zip(*windows, strict=True))
    known = information > 0
    mean = (information * shift).sum(1) / information.sum(1)
    off = (information * (shift - mean[:, None]).square())[known]
    groups = float(known.sum(1).double().median())
    if groups < 2 or not len(off):
        return ColorTravel(line[:0], line[:0], line[:0], 0.0)
    scale = off.nanmedian() / _MEDIAN_CHI_SQUARE * groups / (groups - 1)
    sigma = (scale / information.sum(1)).sqrt() / lag.abs()
    seen = (sigma < _UNSURE) & mean.isfinite()
    rate = lag / (lag + mean)
    return ColorTravel(line[seen], rate[seen], sigma[seen], float(seen.double().mean()))


def _windows(pair: ColorPair, columns: slice) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Of each window: line of green, lines between the colours, and by group how many more, and the information."""
    rows, (later, earlier) = pair.rows(), pair.taken()
    number = torch.arange(_WINDOW, dtype=torch.float64)
    # Streaks along a motion askew would look like a shift along the lines, were the columns not those of each colour.
    column = torch.arange(columns.start, columns.stop, dtype=torch.float64)
    middle_mm = pair.depth.lines_mm.mean()
    z, beyond = middle_mm + pair.depth.beside_mm, pair.depth.beside_mm / middle_mm
    seen_at = [
        pair.frame.shifted_column(column, z, pair.frame.plane_y(column.new_tensor(shift), z)) for shift in pair.shift_mm
    ]
    for middle in range(_WINDOW // 2, pair.scan.lines - _WINDOW // 2, _HOP):
        around = slice(middle - _HOP // 2, middle + _HOP // 2)
        apart = float((rows[0, around] - rows[1, around]).mean())
        one = round(float(rows[0, middle])) - _WINDOW // 2
        starts = one, one - round(apart)
        if min(starts) < 0 or max(starts) + _WINDOW > pair.scan.lines:
            continue
        # The taper lies on the same piece of the object, else steep spectra would lean to long waves.
        places = number, number + (apart - round(apart))
        spectra = [
            torch.fft.rfft(_tapered(_at_columns(pair.left(channel, start, start + _WINDOW), column), place), dim=0)
            for channel, start, place, column in zip(pair.channels, starts, places, seen_at, strict=True)
        ]
        lag = (later[around] - earlier[around]).mean()
        shift, information = _shift(spectra[0], _delayed(spectra[1], lag * beyond), round(apart) - apart)
        line = rows.new_tensor(float(middle) + one + _WINDOW // 2 - float(rows[0, middle]))
        yield line, lag, shift, information


def _delayed(spectra: Tensor, rows: Float[Tensor, " columns"]) -> Tensor:
    """Spectra of columns that are shown so many rows later."""
    frequency = torch.arange(len(spectra), dtype=torch.float64) / _WINDOW
    return spectra * torch.polar(torch.ones(()).double(), -2 * math.pi * frequency[:, None] * rows).to(spectra.dtype)


def _at_columns(values: Float[Tensor, "rows width"], column: Float[Tensor, " columns"]) -> Tensor:
    """Values at fractional columns."""
    base = column.floor().long().clamp(0, values.shape[1] - 2)
    return torch.lerp(values[:, base], values[:, base + 1], (column - base).clamp(0, 1).float())


def _tapered(values: Float[Tensor, "rows columns"], place: Float[Tensor, " rows"]) -> Tensor:
    """Values less their mean, under a Hann window at fractional rows."""
    taper = torch.sin(math.pi * (place + 0.5) / _WINDOW).square()[:, None].float()
    return taper * (values - (taper * values).sum(0) / taper.sum())


def _shift(one: Tensor, other: Tensor, beside: float) -> tuple[Float[Tensor, " groups"], Float[Tensor, " groups"]]:
    """Rows by which one image lags behind the other beyond what is expected, by groups of columns, and information.

    Args:
        beside: rows between the two windows beyond the expected ones.
    """
    frequency = torch.arange(len(one), dtype=torch.float64) / _WINDOW
    inside = (frequency >= _BAND[0]) & (frequency <= _BAND[1])
    angle = 2 * math.pi * frequency[inside]
    group = torch.arange(one.shape[1]) // _PIECE_PX % _GROUPS
    cross, power = (one * other.conj())[inside], [part.abs().square()[inside].double().sum(1) for part in (one, other)]
    by_group = torch.zeros(len(angle), _GROUPS, dtype=torch.complex128).index_add_(1, group, cross.to(torch.complex128))
    total = by_group.sum(1)
    coherence = (total.abs().square() / (power[0] * power[1]).clamp(min=1e-9)).clamp(max=0.999)
    weight = coherence / (1 - coherence) / total.abs().clamp(min=1e-9)
    shift = torch.zeros((), dtype=torch.float64)
    for _ in range(_STEPS):
        turned = total * torch.exp(1j * angle * shift)
        bend = (weight * angle.square() * turned.real).sum().clamp(min=1e-9)
        shift = (shift - (weight * angle * turned.imag).sum() / bend).clamp(-1.0, 1.0)
    turned = by_group * torch.exp(1j * angle * shift)[:, None]
    bend = ((weight * angle.square())[:, None] * turned.real).sum(0)
    step = -((weight * angle)[:, None] * turned.imag).sum(0) / bend
    known = bend > 0
    return torch.where(known, shift + step + beside, 0.0), torch.where(known, bend, 0.0)
