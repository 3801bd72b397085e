"""An image whose samples lie elsewhere in another one: resampled where it is read, by line ranges."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.column_shifts import in_range
from lsvision.image.sheared_rows import ShearedRows
from lsvision.image.tiling import tiles
from lsvision.types import LineImage, missing_ranges

_REACH = 2  # samples beside a position that an interpolation reads
_TILE, _LINES = (128, 1024), 8  # that stay in the processor's cache


@dataclass(frozen=True)
class ResampledImage:
    """A ``LineImage`` of which column u of row r shows ``source`` at column ``columns[u]`` of the line of ``rows``.

    Columns grow; a slice takes some of the source as they are. Beyond its ends the source is repeated; see ``outside``.
    Values are interpolated by cubics along a line, and linearly where only rows differ from lines.
    """

    source: LineImage
    columns: Float[Tensor, " width"] | slice
    rows: ShearedRows

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, width, channels)."""
        return self.rows.rows, len(self._places), self.source.shape[2]

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
        return self.read_as(range(start, stop), lambda values: values)

    def read_as(self, rows: range, made: Callable[[Tensor], Tensor]) -> Tensor:
        """Some rows of what is made of the source's values, ``(lines, width, channels)``, for each sample by itself."""
        lines = self.source_lines(rows)
        return self.resample(made(self.source.read(lines.start, lines.stop)), lines.start, rows)

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
            plane = plane[:, self.columns].contiguous() if self._taps is None else self._taps.of(plane)
            self._write_rows(plane, first_line, rows, out[..., channel])
        return out

    def _write_rows(self, plane: Tensor, first_line: int, rows: range, out: Tensor) -> None:
        """Write what some rows show of lines from a first one on, which have the image's columns."""
        if self.rows.late_mm is None:  # rows are lines
            taken = torch.arange(rows.start, rows.stop) + (self.rows.first - first_line)
            out[:] = in_range(plane[taken.clamp_(0, len(plane) - 1)], out.dtype)
            return
        shifted = self.rows.shifted(rows, self.source.shape[0])
        if shifted:
            assert self.rows.shifts is not None
            wanted = slice(shifted.start - rows.start, shifted.stop - rows.start)
            self.rows.shifts.interpolate(plane, shifted.start + self.rows.first - first_line, out[wanted])
        for others in (range(rows.start, shifted.start), range(shifted.stop, rows.stop)):
            for tile in self._tiles(others, first_line, along_lines=False):
                found = cv2.remap(
                    plane.numpy(), tile.column, tile.line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
                out[others.start - rows.start :][tile.at] = in_range(torch.from_numpy(found), out.dtype)

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
        # Rows on which all columns lie inside are none of them.
        first, stop = math.ceil(float(self.ends[0].max())) + 1, math.floor(float(self.ends[1].min())) - 1
        number = torch.arange(rows.start, rows.stop, dtype=torch.float64)
        number = number[(number < first) | (number >= stop)]
        at = self.rows.lines(number)
        beyond = (at < 0) | (at > last)
        if not bool(beyond.any()):
            return None
        out = torch.zeros(len(rows), self.shape[1], dtype=torch.bool)
        out[number.long() - rows.start] = beyond
        return out

    @cached_property
    def ends(self) -> Float[Tensor, "2 width"]:
        """The (fractional) rows of the source's first and last line, by column."""
        lines = torch.tensor([0.0, self.source.shape[0] - 1.0], dtype=torch.float64)
        return self.rows.rows_of(lines).expand(2, self.shape[1])

    @cached_property
    def _taps(self) -> "_Taps | None":
        return None if isinstance(self.columns, slice) else _Taps.at(self.columns, self.source.shape[1])

    @cached_property
    def _places(self) -> Tensor:
        """Columns of the source, float64."""
        if isinstance(self.columns, slice):
            return torch.arange(self.source.shape[1], dtype=torch.float64)[self.columns]
        return self.columns

    def _tiles(self, rows: range, first_line: int, *, along_lines: bool) -> "Iterator[_Positions]":
        """Where the samples of some rows lie: in columns of the source, or of what is interpolated along its lines."""
        number = torch.arange(rows.start, rows.stop, dtype=torch.float64)
        columns = self._places.float() if along_lines else torch.arange(self.shape[1], dtype=torch.float32)
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
