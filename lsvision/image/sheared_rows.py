"""Rows that run askew through the lines of a scan."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.geometry import line_at, travel_at
from lsvision.image.column_shifts import ColumnShifts
from lsvision.image.tiling import PIXEL_PARTS
from lsvision.types import Travel

_KNOT_PX = 64  # columns between those for which lines of an uneven travel are looked up


@dataclass(frozen=True)
class ShearedRows:
    """Rows that run askew through the lines of a scan.

    Column u of row r lies ``late_mm[u]`` of travel after line r + ``first``, which need not be there.

    Attributes:
        rows: number of rows. late_mm: by column, float64; None where rows are lines.
    """

    travel: Travel
    rows: int
    first: int = 0
    late_mm: Float[Tensor, " width"] | None = None

    def lines(
        self, rows: Float[Tensor, " rows"], columns: slice | Int[Tensor, " columns"] = slice(None)
    ) -> Float[Tensor, "rows columns"]:
        """(Fractional) lines that columns of some rows lie on, to 1/2048."""
        at = rows[:, None] + self.first
        return at if self.late_mm is None else self._later(at, 1.0, columns)

    def rows_of(
        self, lines: Float[Tensor, " lines"], columns: slice | Int[Tensor, " columns"] = slice(None)
    ) -> Float[Tensor, "lines columns"]:
        """(Fractional) rows on which some lines lie in columns, to 1/2048: the inverse of ``lines``."""
        at = lines[:, None]
        return (at if self.late_mm is None else self._later(at, -1.0, columns)) - self.first

    def rows_after(self, row: int, lines: range, columns: Int[Tensor, " columns"]) -> Float[Tensor, "lines columns"]:
        """The rows on which some lines lie in columns, counted from one near them; float32 is exact."""
        if self.late_mm is None or self.late_lines is not None:
            at = torch.arange(lines.start - row - self.first, lines.stop - row - self.first, dtype=torch.float32)[
                :, None
            ]
            return at if self.late_lines is None else at - self.late_lines[columns].float()
        return (self.rows_of(torch.arange(lines.start, lines.stop, dtype=torch.float64), columns) - row).float()

    def reach(self, lines: tuple[int, int]) -> tuple[int, int]:
        """First row, and one past the last, that lines ``lines[0]..lines[1]-1`` lie on or between."""
        rows = self.rows_of(torch.tensor([lines[0], lines[1] - 1], dtype=torch.float64))
        return max(math.floor(float(rows.min())), 0), min(math.floor(float(rows.max())) + 2, self.rows)

    @cached_property
    def late_lines(self) -> Float[Tensor, " width"] | None:
        """``late_mm`` in lines of an even travel, rounded, so that a row plus it is exact; None where it is uneven."""
        if self.late_mm is None or self.travel.positions_mm is not None:
            return None
        return _rounded(line_at(self.travel, self.late_mm))

    @cached_property
    def shifts(self) -> ColumnShifts | None:
        """By how many lines each column of a row lies after line r + ``first``; None where that is uneven."""
        return None if self.late_lines is None else ColumnShifts.of(self.late_lines)

    def shifted(self, rows: range, lines: int) -> range:
        """Those of some rows on which every column is shifted by ``shifts``, and lies inside of a scan of ``lines``.

        They begin and end at the same places, whatever rows are asked for.
        """
        if self.shifts is None:
            return range(rows.start, rows.start)
        first = -self.first - int(self.shifts.whole.min())
        stop = lines - 1 - self.first - int(self.shifts.whole.max())
        start = min(max(rows.start, first), rows.stop)
        return range(start, max(min(rows.stop, stop), start))

    def _later(
        self, line: Float[Tensor, "rows 1"], sign: float, columns: slice | Tensor
    ) -> Float[Tensor, "rows columns"]:
        if self.late_lines is not None:
            return line + sign * self.late_lines[columns]
        late_mm = line.new_zeros(1) if self.late_mm is None else sign * self.late_mm
        wanted = torch.arange(len(late_mm))[columns]
        knots = torch.arange(int(wanted[0]) // _KNOT_PX, int(wanted[-1]) // _KNOT_PX + 2) * _KNOT_PX
        knots = knots.clamp(max=len(late_mm) - 1)
        at_knots = line_at(self.travel, travel_at(self.travel, line) + late_mm[knots])
        base = (torch.searchsorted(knots, wanted, right=True) - 1).clamp(0, len(knots) - 2)
        share = ((wanted - knots[base]) / (knots[base + 1] - knots[base]).clamp(min=1)).to(at_knots)
        return _rounded(torch.lerp(at_knots[:, base], at_knots[:, base + 1], share))


def _rounded(position: Tensor) -> Tensor:
    """Positions to a part of a pixel that single precision holds, too."""
    return (position * PIXEL_PARTS).round_().div_(PIXEL_PARTS)
