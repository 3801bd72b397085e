"""Segments of a surface that is sampled along lines, and their fragments: what they show at the cells they cover."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.ragged import ragged_range
from lsvision.image.tiling import PIXEL_PARTS

_Ends = Callable[[Tensor], tuple[Tensor, Tensor]]  # values of samples at the begin and at the end of segments


@dataclass(frozen=True)
class Surface:
    """A surface of lines side by side, sampled along one axis of its ``(rows, columns)`` tensors.

    Sample i lies at cell ``whole[i] + part``: kept apart, single precision holds a thousandth of a cell at any
    distance, and whole cells are added and subtracted without rounding. Segments lie between neighbouring samples.

    Args:
        whole: whole numbers. part: NaN where there is no sample.
        height: orders surfaces, higher is nearer. carried: further values to interpolate.
        connected: whether the surface continues along a segment; false across steps and beside holes.
        measured: whether a segment is more than a guess.
    """

    whole: Float[Tensor, " samples"]
    part: Float[Tensor, "rows columns"]
    height: Float[Tensor, "rows columns"]
    carried: Sequence[Float[Tensor, "rows columns"]]
    connected: Bool[Tensor, "segments columns"] | Bool[Tensor, "rows segments"]
    measured: Bool[Tensor, "segments columns"] | Bool[Tensor, "rows segments"]


@dataclass(frozen=True)
class Seen:
    """What cells see, or fragments: what single segments show at single cells. NaN and False where nothing is seen.

    ``place`` i + fraction lies between the samples i and i + 1.
    Places are whole multiples of 1/2048 of the distance between two samples.
    """

    place: Tensor
    height: Tensor
    carried: tuple[Tensor, ...]
    measured: Tensor

    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors in a fixed order."""
        return self.place, self.height, self.measured, *self.carried

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> "Seen":
        """From all tensors in the order of ``tensors``."""
        place, height, measured, *carried = tensors
        return cls(place, height, tuple(carried), measured)

    def select(self, which: Tensor) -> "Seen":
        """Some of the cells, by a mask or by indices."""
        return Seen.of([values[which] for values in self.tensors()])

    def rasterise(self, cell: Tensor, cells: int) -> "Seen":
        """A buffer of cells from fragments: each cell holds the last fragment written to it, NaN and False for none."""

        def empty(values: Tensor) -> Tensor:
            return values.new_full((cells,), False if values.dtype == torch.bool else torch.nan)

        return Seen.of([empty(values).scatter_(0, cell, values) for values in self.tensors()])

    def write(self, cell: Tensor, fragments: "Seen") -> None:
        """Write fragments to different cells, in place."""
        for values, new in zip(self.tensors(), fragments.tensors(), strict=True):
            values[cell] = new


@dataclass(frozen=True)
class Layout:
    """How lines lie in tensors: along the axis ``dim``, places numbered in the order of memory.

    The kernel works on either layout. To work on one and transpose the tensors of the other takes 5 % of a correction.
    """

    dim: Literal[0, 1]

    def along(self, values: Tensor) -> Tensor:
        """A vector of values along each line, to be broadcast over the lines."""
        return values.view((-1, 1) if self.dim == 0 else (1, -1))

    def across(self, values: Tensor) -> Tensor:
        """A vector with a value for each line, to be broadcast along the lines."""
        return values.view((1, -1) if self.dim == 0 else (-1, 1))

    def ends(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Values at the begin and at the end of every segment."""
        segments = samples.shape[self.dim] - 1
        return samples.narrow(self.dim, 0, segments), samples.narrow(self.dim, 1, segments)

    def number(self, place: Tensor, line: Tensor, columns: int) -> Tensor:
        """Number of a place of a line in a tensor of some columns."""
        return place * columns + line if self.dim == 0 else line * columns + place

    def split(self, number: Tensor, columns: int) -> tuple[Tensor, Tensor]:
        """Place and line of a number in a tensor of some columns."""
        row, column = number // columns, number % columns
        return (row, column) if self.dim == 0 else (column, row)


@dataclass(frozen=True)
class Segments:
    """The segments of a surface.

    Args:
        first: the first cell. count: number of cells; zero or less for a segment that runs backwards.
        offset: from the first sample to the first cell, in cells. length: in cells, positive.
    """

    surface: Surface
    layout: Layout
    first: Tensor
    count: Tensor
    offset: Tensor
    length: Tensor

    @classmethod
    def of(cls, surface: Surface, layout: Layout) -> "Segments":
        """All segments of a surface."""
        whole, next_whole = layout.ends(layout.along(surface.whole))
        begin, end = layout.ends(surface.part)
        begin_cell, end_cell = layout.ends(surface.part.ceil())
        gap = next_whole - whole
        return cls(
            surface,
            layout,
            first=begin_cell + whole,
            count=(end_cell - begin_cell).add_(gap),
            offset=begin_cell - begin,
            length=_length(begin, end, gap),
        )

    def covers(self, cells: int) -> Tensor:
        """Which segments are part of the surface and cover at least a number of cells."""
        return self.surface.connected & (self.count >= cells)

    def further_cells(self, cells: int) -> tuple[Tensor, Tensor]:
        """All cells but the first of each segment: the numbers of the segments, and the cells below ``cells``."""
        several = self.covers(2).view(-1).nonzero()[:, 0]
        first, count = self.first.view(-1)[several], self.count.view(-1)[several]
        begin = (first + 1).clamp_(min=0)
        which, offset = ragged_range((first + count).clamp_(max=cells).sub_(begin).clamp_(min=0).long())
        return several[which], begin.long()[which] + offset

    def line(self, segment: Tensor) -> Tensor:
        """Lines of the segments of some numbers."""
        return self.layout.split(segment, self.length.shape[1])[1]

    def at_first_cells(self) -> Seen:
        """Fragment of every segment at its first cell."""
        index = torch.arange(len(self.surface.whole) - 1, dtype=self.length.dtype, device=self.length.device)
        fraction = (self.offset / self.length).clamp_(max=1.0)
        fragments = self._interpolated(self.layout.ends, self.layout.along(index), fraction, self.surface.measured)
        return Seen.of([values.view(-1) for values in fragments.tensors()])

    def at_cells(self, segment: Tensor, cell: Tensor) -> Seen:
        """Fragments of the segments of some numbers at one cell each."""
        whole, part, columns = self.surface.whole, self.surface.part, self.surface.part.shape[1]
        index, line = self.layout.split(segment, self.length.shape[1])
        begin, end = (self.layout.number(sample, line, columns) for sample in (index, index + 1))

        def ends(samples: Tensor) -> tuple[Tensor, Tensor]:
            return samples.view(-1)[begin], samples.view(-1)[end]

        begin_part, end_part = ends(part)
        length = _length(begin_part, end_part, whole[index + 1] - whole[index])
        fraction = (cell - whole[index] - begin_part).div_(length).clamp_(max=1.0)
        measured = self.surface.measured.view(-1)[segment]
        return self._interpolated(ends, index.to(fraction.dtype), fraction, measured)

    def _interpolated(self, ends: _Ends, index: Tensor, fraction: Tensor, measured: Tensor) -> Seen:
        """Fragments at fractions of segments; ``ends`` returns the samples at either end of each."""
        height, *carried = (
            torch.lerp(*ends(values), fraction) for values in (self.surface.height, *self.surface.carried)
        )
        place = (fraction * PIXEL_PARTS).round_().div_(PIXEL_PARTS).add_(index)
        return Seen(place, height, tuple(carried), measured)


def _length(begin: Tensor, end: Tensor, gap: Tensor) -> Tensor:
    """Lengths of segments whose ends lie whole cells apart; positive where rounding lets one of none cover a cell."""
    return (end - begin).add_(gap).clamp_(min=torch.finfo(begin.dtype).eps)
