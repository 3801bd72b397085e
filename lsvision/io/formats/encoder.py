"""The encoder log of a scan: a measured position for every line."""

import csv
import io
import logging
import math
from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.atomic import write_text
from lsvision.io.formats.encoder_sigma import interpolation_sigma
from lsvision.io.formats.validation import read_text

HEADER = ["line", "position_mm"]

# A gap over which the object moved by less than this part of its usual advance was a halt, not a few lost readings.
_STANDSTILL = 0.5
_MANY = 1000  # times the usual advance of a line: no object moved by that, a reading is wrong
_COARSE = 1.5  # times the pitch: a counter of this step repeats readings although the object moves
_COUNT_ERROR = 0.01  # of a step, by which multiples may differ as they are rounded in the file
_UNIT_FACTOR = 2.0  # between the advance of a line and the scan's pitch; a unit slip is more
_UNITS = {1e6: "nm", 1e3: "um", 1e-1: "cm", 1 / 25.4: "inches", 1e-3: "m"}
_CLOSE = 1e-6  # part of the way to the next good reading that lines of a halt are spread over

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EncoderLog:
    """Positions by line, mm, with their standard deviation, above zero where a line was repaired; None: none was."""

    positions_mm: Float[Tensor, " lines"]
    sigma_mm: Float[Tensor, " lines"] | None = None


def read_encoder(
    path: Path | str, lines: int, *, line_pitch_mm: float | None = None, repair: bool = False
) -> Float[Tensor, " lines"]:
    """Positions, mm, of the lines of a log: those of ``read_encoder_log``."""
    return read_encoder_log(path, lines, line_pitch_mm=line_pitch_mm, repair=repair).positions_mm


def read_encoder_log(
    path: Path | str, lines: int, *, line_pitch_mm: float | None = None, repair: bool = False
) -> EncoderLog:
    """The first ``lines`` lines of a log with the header ``line,position_mm``.

    Args:
        line_pitch_mm: nominal pitch, which the advance of a line is compared with; None where there is none.
        repair: interpolate lines that are missing or break the increase, and log a warning, instead of raising.

    Raises:
        FileFormatError: not such a log, shorter than the scan, in another unit, or with faults that are not, or cannot
            be, repaired.
    """
    path = Path(path)
    line, position = _parse(path)
    line, position = line[line < lines], position[line < lines]
    if lines - 1 not in line:
        last = f"ends at line {line.max()}" if line.size else "is empty"
        raise FileFormatError(path, f"the log {last}, the scan has {lines} lines")
    if line_pitch_mm is not None and (problem := _unit_problem(line, position, line_pitch_mm)):
        raise FileFormatError(path, problem)
    faults = _faults(line, position, lines)
    if not faults:
        return EncoderLog(torch.from_numpy(position))
    if not repair:
        raise FileFormatError(path, f"{faults}; repair was not asked for")
    counter_sigma = 0.0
    if line_pitch_mm is not None:
        resolution = counter_resolution(line, position)
        if resolution > _COARSE * line_pitch_mm:
            faults = f"{faults}; the readings are multiples of {resolution:g} mm, between which lines are interpolated"
            position = without_counter_steps(line, position, resolution / line_pitch_mm)
            counter_sigma = resolution / math.sqrt(12)  # of a position anywhere in a step
    repaired = _repaired(path, line, position, counter_sigma)
    logger.warning("%s: repaired by interpolation: %s", path, faults)
    return repaired


def write_encoder(positions_mm: Float[Tensor, " lines"], path: Path | str) -> None:
    """Write a log, one line of the scan a row."""
    rows = "".join(f"{line},{position!r}\n" for line, position in enumerate(positions_mm.double().tolist()))
    write_text(path, ",".join(HEADER) + "\n" + rows)


def _parse(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Line numbers, sorted, and positions of all rows."""
    text = read_text(path)
    header = next(csv.reader(io.StringIO(text), skipinitialspace=True), [])
    if [name.strip() for name in header] != HEADER:
        raise FileFormatError(path, f"expected the header {','.join(HEADER)}")
    body = text.split("\n", 1)[1] if "\n" in text else ""
    if not body.strip():
        return np.empty(0, np.int64), np.empty(0)
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2)
    except ValueError as error:
        raise FileFormatError(path, f"expected numbers in two columns: {error}") from error
    if table.shape[1] != 2:
        raise FileFormatError(path, f"expected two columns, got {table.shape[1]}")
    sound = np.isfinite(table).all(1) & (table[:, 0] >= 0) & (table[:, 0] == np.floor(table[:, 0]))
    if not sound.all():
        raise FileFormatError(path, f"row {int(np.argmin(sound)) + 2}: expected a line number and a finite position")
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0].astype(np.int64), np.ascontiguousarray(table[:, 1])


def _faults(line: NDArray[np.int64], position: NDArray[np.float64], lines: int) -> str:
    """What is wrong with a log, in words; empty where nothing is."""
    again = np.append(False, line[1:] == line[:-1])
    kept, advance = line[~again], np.diff(position[~again])
    faults = {
        "missing": np.setdiff1d(np.arange(lines), kept),
        "repeated": np.unique(line[again]),
        "not beyond the line before": kept[1:][advance <= 0],
        f"more than {_MANY} times the usual advance beyond the line before": kept[1:][_jumps(kept, position[~again])],
    }
    return "; ".join(f"{_listed(found)} {kind}" for kind, found in faults.items() if found.size)


def _unit_problem(line: NDArray[np.int64], position: NDArray[np.float64], line_pitch_mm: float) -> str | None:
    """What is wrong with the unit of a log, in words; None where its usual advance is about the pitch."""
    advance = _usual_advance(line, position)
    ratio = advance / line_pitch_mm
    if advance == 0 or 1 / _UNIT_FACTOR <= ratio <= _UNIT_FACTOR:
        return None
    units = [name for factor, name in _UNITS.items() if 1 / _UNIT_FACTOR <= ratio / factor <= _UNIT_FACTOR]
    guess = f"are these {units[0]}?" if units else "does the log belong to this scan?"
    return f"expected about {line_pitch_mm:g} mm a line, the scan's line_pitch_mm, got {advance:g} (median): {guess}"


def _usual_advance(line: NDArray[np.int64], position: NDArray[np.float64]) -> float:
    """Median advance of a line, mm, from one change of the reading to the next; 0 where it never advances.

    Neither a halt nor the repeated readings of a coarse counter make it smaller.
    """
    changed = np.append(True, np.diff(position) != 0)
    elapsed, advance = np.diff(line[changed]), np.diff(position[changed])
    forward = (elapsed > 0) & (advance > 0)
    return float(np.median(advance[forward] / elapsed[forward])) if forward.any() else 0.0


def _jumps(line: NDArray[np.int64], position: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which readings, but the first, lie much further beyond the one before than an object can have moved."""
    usual = _usual_advance(line, position)
    jumps: NDArray[np.bool_] = np.diff(position) > _MANY * usual * np.diff(line)
    return jumps


def _listed(lines: NDArray[np.int64]) -> str:
    shown = ", ".join(map(str, lines[:5].tolist()))
    return f"line {shown}" if lines.size == 1 else f"{lines.size} lines ({shown}{', ...' if lines.size > 5 else ''})"


def _repaired(path: Path, line: NDArray[np.int64], position: NDArray[np.float64], counter_sigma: float) -> EncoderLog:
    """Positions with every line outside the longest increasing run of readings interpolated.

    Where the object stood or went back, the lines in between saw it again where it had been already: they are put
    close together beside a good reading, so that no part of the object is taken from them.
    """
    first = np.append(True, line[1:] != line[:-1])
    line, position = line[first], position[first]
    good = _longest_increasing(position)
    step = np.diff(position[good], prepend=-np.inf)
    good = good[step > _CLOSE * np.median(step[1:])] if len(good) > 1 else good  # rounding is no progress
    pieces = np.split(good, np.flatnonzero(_jumps(line[good], position[good])) + 1)
    good = max(pieces, key=len)  # what lies beyond a jump is wrong, be it the last reading alone
    if line[good[0]] != 0 or line[good[-1]] != line[-1]:
        raise FileFormatError(path, "cannot be repaired: the first or the last line has no good reading")
    elapsed, advance = np.diff(line[good]), np.diff(position[good])
    stood = (elapsed > 1) & (advance < _STANDSTILL * np.median(advance / elapsed) * elapsed)
    before, after, advance = good[:-1][stood], good[1:][stood], advance[stood]
    # Beside the good reading that the object was nearer to when it came to the other.
    early = np.abs(position[after - 1] - position[before]) <= np.abs(position[before + 1] - position[after])
    knots = np.where(early, line[after] - 1, line[before] + 1)
    values = np.where(early, position[before] + _CLOSE * advance, position[after] - _CLOSE * advance)
    knots, values = np.append(line[good], knots), np.append(position[good], values)
    order = np.argsort(knots)
    repaired = np.interp(np.arange(line[-1] + 1), knots[order], values[order])
    sigma = np.hypot(interpolation_sigma(line[good], position[good], stood), counter_sigma)
    return EncoderLog(torch.from_numpy(repaired), torch.from_numpy(sigma))


def counter_resolution(line: NDArray[np.int64], position: NDArray[np.float64]) -> float:
    """Step, mm, of a log whose readings all are multiples of one, as those of a counter; 0 where they are not."""
    advance = np.abs(np.diff(position))
    moved = advance[advance > 0]
    if moved.size == 0:
        return 0.0
    step = float(moved.min())
    counts = moved / step
    return step if np.abs(counts - counts.round()).max() < _COUNT_ERROR else 0.0


def without_counter_steps(
    line: NDArray[np.int64], position: NDArray[np.float64], lines_a_step: float
) -> NDArray[np.float64]:
    """Readings of a coarse counter with the advance of each step spread over its lines.

    A reading stands for the middle of the lines that share it. Of the first and the last nobody knows how many lines
    they lack, so that the steps beside them are continued. A reading that more lines share than twice the usual number
    is a halt: its lines keep it, except for half a step at either end.
    """
    starts = np.flatnonzero(np.append(True, np.diff(position) != 0))
    first, last = line[starts], line[np.append(starts[1:], len(line)) - 1]
    halt = last - first + 1 > 2 * np.ceil(lines_a_step)
    inset = np.where(halt, lines_a_step / 2 - 0.5, (last - first) / 2)
    known = halt.copy()
    known[1:-1] = True
    if known.sum() < 2:
        return position
    knots = np.stack([first + inset, last - inset], axis=1)[known].ravel()
    values = np.repeat(position[starts][known], 2)
    repaired = np.interp(line, knots, values)
    rate = _usual_advance(line, position)
    repaired += rate * np.minimum(line - knots[0], 0) + rate * np.maximum(line - knots[-1], 0)
    return np.asarray(repaired)


def _longest_increasing(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the longest strictly increasing subsequence: what a single wrong reading, however far off, spares.

    Inherently sequential, and run only on logs that are known to be faulty.

    Source: Fredman 1975, On computing the length of longest increasing subsequences.
    """
    tails: list[float] = []
    tail_index: list[int] = []
    before = np.full(len(values), -1, np.int64)
    for index, value in enumerate(values.tolist()):
        length = bisect_left(tails, value)
        tails[length : length + 1] = [value]
        tail_index[length : length + 1] = [index]
        before[index] = tail_index[length - 1] if length else -1
    chain = [tail_index[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])
