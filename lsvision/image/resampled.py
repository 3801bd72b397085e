"""An image whose samples lie elsewhere in another one: resampled where it is read, by line ranges."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from torch import Tensor

from lsvision.geometry import line_at, travel_at
from lsvision.image.tiling import PIXEL_PARTS, tiles
from lsvision.types import LineImage, Travel, missing_ranges

_REACH = 2  # samples beside a position that an interpolation reads
_TILE, _LINES = (128, 1024), 32  # that stay in the processor's cache
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
        if self.late_mm is None or self._late_lines is not None:
            at = torch.arange(lines.start - row - self.first, lines.stop - row - self.first, dtype=torch.float32)[
                :, None
            ]
            return at if self._late_lines is None else at - self._late_lines[columns].float()
        return (self.rows_of(torch.arange(lines.start, lines.stop, dtype=torch.float64), columns) - row).float()

    def reach(self, lines: tuple[int, int]) -> tuple[int, int]:
        """First row, and one past the last, that lines ``lines[0]..lines[1]-1`` lie on or between."""
        rows = self.rows_of(torch.tensor([lines[0], lines[1] - 1], dtype=torch.float64))
        return max(math.floor(float(rows.min())), 0), min(math.floor(float(rows.max())) + 2, self.rows)

    @cached_property
    def _late_lines(self) -> Float[Tensor, " width"] | None:
        """``late_mm`` in lines of an even travel, rounded, so that a row plus it is exact; None where it is uneven."""
        if self.late_mm is None or self.travel.positions_mm is not None:
            return None
        return _rounded(line_at(self.travel, self.late_mm))

    def _later(
        self, line: Float[Tensor, "rows 1"], sign: float, columns: slice | Tensor
    ) -> Float[Tensor, "rows columns"]:
        if self._late_lines is not None:
            return line + sign * self._late_lines[columns]
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


@dataclass(frozen=True)
class ResampledImage:
    """A ``LineImage`` of which column u of row r shows ``source`` at column ``columns[u]`` of the line of ``rows``.

    Columns, which grow, are those of the source where they are None. Beyond its ends the source is repeated; see
    ``outside``. Values are interpolated by cubics along a line, and linearly where only rows differ from lines.
    """

    source: LineImage
    columns: Float[Tensor, " width"] | None
    rows: ShearedRows

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, width, channels)."""
        width, channels = self.source.shape[1:]
        return self.rows.rows, width if self.columns is None else len(self.columns), channels

    @property
    def dtype(self) -> torch.dtype:
        """That of the source."""
        return self.source.dtype

    @cached_property
    def missing(self) -> tuple[range, ...]:
        """Rows of which some column lies on or beside a line that the source lacks."""
        reached = (self.rows.reach((lost.start - _REACH, lost.stop + _REACH)) for lost in missing_ranges(self.source))
        return tuple(range(start, stop) for start, stop in reached if start < stop)

    def read(self, start: int, stop: int) -> Tensor:
        """Rows ``start..stop-1``."""
        rows = range(start, stop)
        lines = self.source_lines(rows)
        return self.resample(self.source.read(lines.start, lines.stop), lines.start, rows)

    def source_lines(self, rows: range) -> range:
        """Lines of the source that some rows are interpolated from."""
        ends = self.rows.lines(torch.tensor([rows.start, rows.stop - 1], dtype=torch.float64))
        last = self.source.shape[0] - 1
        first = min(max(math.floor(float(ends.min())) - _REACH, 0), last)
        return range(first, min(max(math.ceil(float(ends.max())) + _REACH, 0), last) + 1)

    def resample(self, values: Tensor, first_line: int, rows: range) -> Tensor:
        """Some rows of an image whose lines ``source_lines`` have other values, ``(lines, width, channels)``."""
        out = torch.empty(len(rows), self.shape[1], values.shape[2], dtype=values.dtype)
        for channel in range(values.shape[2]):  # OpenCV counts places in 32nds of a pixel where there are several
            plane = values[..., channel]
            plane = plane.contiguous() if self._taps is None else self._taps.of(plane)
            if self.rows.late_mm is None:  # rows are lines
                taken = torch.arange(rows.start, rows.stop) + (self.rows.first - first_line)
                out[..., channel] = _in_range(plane[taken.clamp_(0, len(plane) - 1)], out.dtype)
                continue
            for tile in self._tiles(rows, first_line, along_lines=False):
                found = cv2.remap(
                    plane.numpy(), tile.column, tile.line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
                out[..., channel][tile.at] = _in_range(torch.from_numpy(found), out.dtype)
        return out

    def spread(self, marked: Bool[Tensor, "lines width"], first_line: int, rows: range) -> Bool[Tensor, "rows width"]:
        """Which samples of some rows are interpolated from a marked one of the lines ``source_lines``."""
        out = torch.zeros(len(rows), self.shape[1], dtype=torch.bool)
        near = cv2.dilate(marked.numpy().view(np.uint8), np.ones((3, 3), np.uint8))
        for tile in self._tiles(rows, first_line, along_lines=True):
            if near[tile.window].any():
                found = cv2.remap(near, tile.column, tile.line, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
                out[tile.at] = torch.from_numpy(found) != 0
        return out

    def outside(self, rows: range) -> Bool[Tensor, "rows width"] | None:
        """Which samples of some rows lie before the source's first line or after its last; None where none does."""
        last = self.source.shape[0] - 1
        ends = self.rows.lines(torch.tensor([rows.start, rows.stop - 1], dtype=torch.float64))
        if float(ends.min()) >= 0 and float(ends.max()) <= last:
            return None
        at = self.rows.lines(torch.arange(rows.start, rows.stop, dtype=torch.float64))
        return ((at < 0) | (at > last)).expand(-1, self.shape[1])

    @cached_property
    def _taps(self) -> "_Taps | None":
        return None if self.columns is None else _Taps.at(self.columns, self.source.shape[1])

    def _tiles(self, rows: range, first_line: int, *, along_lines: bool) -> "Iterator[_Positions]":
        """Where the samples of some rows lie: in columns of the source, or of what is interpolated along its lines."""
        number = torch.arange(rows.start, rows.stop, dtype=torch.float64)
        columns = torch.arange(self.shape[1], dtype=torch.float32)
        if along_lines and self.columns is not None:
            columns = self.columns.to(torch.float32)
        for tile in tiles(len(rows), self.shape[1], _TILE):
            line = (self.rows.lines(number[tile[0]], tile[1]) - first_line).to(torch.float32)
            column, line = torch.broadcast_tensors(columns[tile[1]], line)
            yield _Positions(tile, column.contiguous().numpy(), line.contiguous().numpy())


@dataclass(frozen=True)
class _Taps:
    """The four samples of a line that each of some places is interpolated from, and their weights.

    The cubics are those of Catmull and Rom 1974, as ``warp_cubic``: they leave a ramp where it is. Those of OpenCV,
    with a parameter of -0.75 and places in 32nds of a pixel, move it by up to 0.05 px.
    """

    columns: Int[Tensor, "4 width"]
    weights: Float[Tensor, "4 width"]

    @classmethod
    def at(cls, places: Float[Tensor, " width"], source_width: int) -> "_Taps":
        """Those of places on lines of a width, whose ends are repeated."""
        base = places.floor()
        t = places - base
        weights = [
            ((2 - t) * t - 1) * t / 2,
            ((3 * t - 5) * t * t + 2) / 2,
            ((4 - 3 * t) * t + 1) * t / 2,
            (t - 1) * t * t / 2,
        ]
        columns = torch.stack([base + shift for shift in (-1, 0, 1, 2)]).long().clamp(0, source_width - 1)
        return cls(columns, torch.stack(weights).to(torch.float32))

    def of(self, image: Shaped[Tensor, "lines source_width"]) -> Float[Tensor, "lines width"]:
        """What lies at the places on the lines of an image; float32."""
        out = torch.empty(len(image), self.columns.shape[1])
        for start in range(0, len(image), _LINES):
            lines = image[start : start + _LINES].to(torch.float32)
            taken = out[start : start + _LINES].zero_()
            for columns, weights in zip(self.columns, self.weights, strict=True):
                taken.addcmul_(lines.index_select(1, columns), weights)
        return out


def _in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Values in another dtype, rounded and clamped to its range if it is one of whole numbers."""
    if dtype.is_floating_point:
        return values.to(dtype)
    return values if values.dtype == dtype else values.round().clamp_(0, torch.iinfo(dtype).max).to(dtype)


@dataclass(frozen=True)
class _Positions:
    """Where the samples of a tile lie in the source: columns that grow, and lines."""

    at: tuple[slice, slice]
    column: NDArray[np.float32]
    line: NDArray[np.float32]

    @property
    def window(self) -> tuple[slice, slice]:
        """The part of the source that they lie in."""
        ends = (self.line.min(), self.line.max()), (self.column[0, 0], self.column[0, -1])
        lines, columns = (slice(max(int(low) - 1, 0), max(int(high) + 3, 1)) for low, high in ends)
        return lines, columns
