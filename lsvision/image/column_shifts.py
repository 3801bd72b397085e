"""Columns that are each shifted along the scan by a distance of their own, the same on every line."""

import itertools
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from lsvision.image.tiling import in_parallel, tiles

_PIECE = (512, 512)  # lines and columns that stay in the processor's cache


@dataclass(frozen=True)
class ColumnShifts:
    """By how many lines each column is shifted: ``whole`` ones, and ``part`` of one more, from 0 to 1, float32.

    Neighbouring columns with the same whole lines make a stretch, of which lines are read as they lie in memory. A
    remap of the same places, which reads each of them by itself, takes three times as long.
    """

    whole: Int[Tensor, " width"]
    part: Float[Tensor, " width"]

    @classmethod
    def of(cls, lines: Float[Tensor, " width"]) -> "ColumnShifts":
        """Those of (fractional) lines, float64."""
        base = lines.floor()
        return cls(base.long(), (lines - base).float())

    @cached_property
    def stretches(self) -> tuple[slice, ...]:
        """The stretches of columns with the same whole lines."""
        steps = (self.whole.diff() != 0).nonzero()[:, 0] + 1
        ends = [0, *steps.tolist(), len(self.whole)]
        return tuple(slice(start, stop) for start, stop in itertools.pairwise(ends))

    def pieces(self, rows: int) -> list[tuple[slice, slice]]:
        """Rows and columns of pieces of an image of so many rows, each within a stretch."""
        return [
            (lines, slice(stretch.start + columns.start, stretch.start + columns.stop))
            for stretch in self.stretches
            for lines, columns in tiles(rows, stretch.stop - stretch.start, _PIECE)
        ]

    def interpolate(self, values: Shaped[Tensor, "lines width"], first: int, out: Shaped[Tensor, "rows width"]) -> None:
        """Write what lies the shifts after the lines from ``first`` on, all of which are there, interpolated linearly.

        Values of ``out`` are rounded and clamped to its type where it is one of whole numbers.
        """

        def fill(piece: tuple[slice, slice]) -> None:
            """Interpolate a piece."""
            rows, columns = piece
            top = first + rows.start + int(self.whole[columns.start])
            lines = values[top : top + rows.stop - rows.start + 1, columns].to(torch.float32)
            # In steps that every processor rounds alike: no bit depends on where a piece ends.
            between = lines.diff(dim=0).mul_(self.part[columns]).add_(lines[:-1])
            out[piece] = in_range(between, out.dtype)

        in_parallel(fill, self.pieces(len(out)))


def in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Values in another dtype, rounded and clamped to its range if it is one of whole numbers."""
    if dtype.is_floating_point:
        return values.to(dtype)
    return values if values.dtype == dtype else values.round().clamp_(0, torch.iinfo(dtype).max).to(dtype)
