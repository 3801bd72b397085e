"""How well the travel of repaired lines of an encoder log is known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LENGTHS = 100  # different lengths of gaps, of which each is tried; of more, those of up to _EXACT_LINES
_EXACT_LINES = 64
_PARTS = 32  # of a gap, in which it is tried
_GROWTH = 1.1  # from one of the longer lengths that are tried to the next
_STARTS = 5_000  # places at which a gap of a length is tried
_GOLDEN = 0.6180339887498949  # spreads them without a period, which the speed may have
_PIECES = 4  # gaps of a length that a log must have room for: of fewer nobody knows the scatter
_TRIED = 30  # gaps that are tried at least
_SURPRISE = 4.0  # times the usual variance of the travel over a gap, beyond which the gap is not a usual one
_LEAST = 1e-6  # part of the usual advance of a line: nothing interpolated is known exactly


def interpolation_sigma(
    line: NDArray[np.int64], position: NDArray[np.float64], stood: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Standard deviation, mm, of the travel of every line that is interpolated between good readings; zero at those.

    It is what the same interpolation misses where the readings are good: the root of the mean square over gaps of that
    length tried all over the log, whatever the speed did there, widened as a variance from few gaps is. Where the log
    has no room to try, it is that of a Brownian bridge under speeds as persistent as the gap is long. A gap over which
    the object advanced unusually adds the excess, at an unknown time in it.

    Args:
        line, position: the good readings, increasing, from the first line to the last.
        stood: gaps between them in which the object stood: it was anywhere between the two readings.
    """
    sigma = np.zeros(line[-1] + 1)
    repaired = np.setdiff1d(np.arange(line[-1] + 1), line)
    if not repaired.size:
        return sigma
    elapsed, advance = np.diff(line), np.diff(position)
    rate = float(np.median(advance / elapsed))
    readings = np.full(line[-1] + 1, np.nan)
    readings[line] = position - rate * line
    speed_sigma = float(np.sqrt(np.mean((advance / elapsed - rate) ** 2)))
    gap = np.searchsorted(line, repaired) - 1
    weight = (repaired - line[gap]) / elapsed[gap]
    tried_length = _tried_lengths(elapsed[gap])
    variance = np.empty(len(repaired))
    for length in np.unique(tried_length):
        of_length = tried_length == length
        trial = _try_gaps(readings, int(length)) or _persistent(speed_sigma, int(length))
        excess = (advance - rate * elapsed)[gap[of_length]] ** 2 - _SURPRISE * trial.travel_variance
        share = weight[of_length]
        usual = np.interp(share, trial.weight, trial.sigma) ** 2
        variance[of_length] = usual + share * (1 - share) * excess.clip(min=0)
    variance = np.where(stood[gap], advance[gap] ** 2 / 3, variance)
    sigma[repaired] = np.sqrt(variance).clip(min=_LEAST * rate)
    return sigma


@dataclass(frozen=True)
class _Gap:
    """Errors of interpolation over gaps of a length: their sigma, mm, by the part of the gap, from 0 to 1.

    ``travel_variance`` is the mean square, mm^2, of the travel over the gap less the usual one.
    """

    weight: NDArray[np.float64]
    sigma: NDArray[np.float64]
    travel_variance: float


def _tried_lengths(length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lengths at which gaps are tried, none shorter than the gap: few, however many lengths there are."""
    if len(np.unique(length)) <= _LENGTHS:
        return length
    steps = np.ceil(np.log(np.maximum(length, _EXACT_LINES) / _EXACT_LINES) / np.log(_GROWTH) - 1e-9)
    longer = np.ceil(_EXACT_LINES * _GROWTH**steps - 1e-6).astype(np.int64)
    return np.where(length <= _EXACT_LINES, length, longer)


def _try_gaps(readings: NDArray[np.float64], length: int) -> _Gap | None:
    """What interpolation over a gap misses where there are readings; None where there are too few.

    Args:
        readings: by line, less the usual travel, NaN where there is none.
    """
    pieces = np.isfinite(readings).sum() / length
    if pieces < _PIECES:
        return None
    room = len(readings) - length
    start = np.arange(room)
    if room > _STARTS:
        start = (np.modf(np.arange(_STARTS) * _GOLDEN)[0] * room).astype(np.int64)
    near = np.unique(np.minimum(2 ** np.arange(length.bit_length()), length // 2))  # close to either end
    even = np.linspace(1, length - 1, _PARTS).astype(np.int64)
    offset = np.unique(np.concatenate([near, even, length - near]))
    weight = offset / length
    first, last = readings[start, None], readings[start + length, None]
    missed = readings[start[:, None] + offset] - first * (1 - weight) - last * weight
    count = np.isfinite(missed).sum(0)
    if count.min() < _TRIED:
        return None
    widened = pieces / (pieces - 2)  # the variance of Student's t
    sigma = np.sqrt(widened * np.nansum(missed**2, 0) / count)
    travel_variance = float(np.nanmean((last - first) ** 2))
    return _Gap(np.concatenate([[0.0], weight, [1.0]]), np.concatenate([[0.0], sigma, [0.0]]), travel_variance)


def _persistent(speed_sigma: float, length: int) -> _Gap:
    """Errors of a Brownian bridge whose travel over the gap scatters as if its speed stayed what it is."""
    weight = np.linspace(0.0, 1.0, 65)
    scatter = speed_sigma * length
    return _Gap(weight, scatter * np.sqrt(weight * (1 - weight)), scatter**2)
