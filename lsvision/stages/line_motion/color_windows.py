"""By how many rows two colours show the same piece of the object apart, in windows along the scan.

The cross-spectrum of the two colours, summed over the columns that show the object, turns with the rows ε by which they
lie further apart than expected,

    phase(f) = -2π f ε,     weights γ² / (1 - γ²), γ² the coherence.

Source: Hannan & Thomson 1973, Estimating group delay (weights); Knapp & Carter 1976.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.line_motion.color_pair import ColorPair

HOP = 64  # lines from one window to the next
_WINDOW = 128  # lines
_BAND = (0.04, 0.3)  # cycles a line: of longer waves a window holds few, shorter ones may be undersampled others
_GROUPS, _PIECE_PX = 8, 16  # of columns, whose scatter shows the errors
_STEPS = 3


def lags_of_windows(pair: ColorPair, columns: slice) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Of each window: line of green, lines between the colours, and by group how many more, and the information."""
    rows, (later, earlier) = pair.rows(), pair.taken()
    number = torch.arange(_WINDOW, dtype=torch.float64)
    # Streaks along a motion askew would look like a shift along the lines, were the columns not those of each colour.
    column = torch.arange(columns.start, columns.stop, dtype=torch.float64)
    middle_mm = pair.place.depth_mm.mean()
    z, beyond = middle_mm + pair.place.beside_mm, pair.place.beside_mm / middle_mm
    seen_at = [
        pair.frame.shifted_column(column, z, pair.frame.plane_y(column.new_tensor(shift), z)) for shift in pair.shift_mm
    ]
    for middle in range(_WINDOW // 2, pair.scan.lines - _WINDOW // 2, HOP):
        around = slice(middle - HOP // 2, middle + HOP // 2)
        apart = float((rows[0, around] - rows[1, around]).mean())
        one = round(float(rows[0, middle])) - _WINDOW // 2
        starts = one, one - round(apart)
        if min(starts) < 0 or max(starts) + _WINDOW > pair.scan.lines:
            continue
        # The taper lies on the same piece of the object, else steep spectra would lean to long waves.
        places = number, number + (apart - round(apart))
        spectra = [
            torch.fft.rfft(_tapered(_steady(pair, which, start, column), place), dim=0)
            for which, (start, place, column) in enumerate(zip(starts, places, seen_at, strict=True))
        ]
        lag = (later[around] - earlier[around]).mean()
        shift, information = _shift(spectra[0], _delayed(spectra[1], lag * beyond), round(apart) - apart)
        line = rows.new_tensor(float(middle) + one + _WINDOW // 2 - float(rows[0, middle]))
        yield line, lag, shift, information


def _delayed(spectra: Tensor, rows: Float[Tensor, " columns"]) -> Tensor:
    """Spectra of columns that are shown so many rows later."""
    frequency = torch.arange(len(spectra), dtype=torch.float64) / _WINDOW
    return spectra * torch.polar(torch.ones(()).double(), -2 * math.pi * frequency[:, None] * rows).to(spectra.dtype)


def _steady(pair: ColorPair, which: int, start: int, column: Float[Tensor, " columns"]) -> Tensor:
    """A window of one colour at fractional columns of the object, wherever these stand on each line.

    Streaks along the object that move sideways between the colours' moments would shorten their lag.
    """
    values, taken = (
        pair.left(pair.channels[which], start, start + _WINDOW),
        start - round(float(pair.registered[which])),
    )
    moved = pair.place.moved_px[torch.arange(taken, taken + _WINDOW).clamp(0, pair.scan.lines - 1)]
    column = column + moved[:, None]
    base = column.floor().long().clamp(0, values.shape[1] - 2)
    left, right = values.gather(1, base), values.gather(1, base + 1)
    return torch.lerp(left, right, (column - base).clamp(0, 1).float())


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
