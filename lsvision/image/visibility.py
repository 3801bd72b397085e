"""Which part of a surface, sampled along lines, is seen at each cell of a regular axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.tiling import PIXEL_PARTS


@dataclass(frozen=True)
class Surface:
    """A surface of lines side by side, sampled along one axis of its ``(rows, columns)`` tensors.

    Sample i lies at cell ``whole[i] + part``: kept apart, single precision holds a thousandth of a cell at any
    distance, and whole cells come and go without rounding. Segments are what lies between neighbouring samples.

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
    """What cells see. ``place`` i + fraction lies between the samples i and i + 1; NaN and False where nothing is.

    Places are whole multiples of 1/2048 of the way between two samples.
    """

    place: Tensor
    height: Tensor
    carried: tuple[Tensor, ...]
    measured: Tensor

    def tensors(self) -> tuple[Tensor, ...]:
        """All of them, in a fixed order."""
        return self.place, self.height, self.measured, *self.carried

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> "Seen":
        """From the same, in that order."""
        place, height, measured, *carried = tensors
        return cls(place, height, tuple(carried), measured)


def see_cells(surface: Surface, cells: int, dim: Literal[0, 1]) -> Seen:
    """Interpolate a surface at the cells 0, 1, .., ``cells`` - 1 along an axis, each line for itself.

    Segments that run backwards are seen from behind and do not count. Where several segments cover a cell, the one
    that is highest there wins: a step or an overhang shows its nearer side. Of equals the later one does.

    Nearly every segment covers one cell and nearly every cell one segment. So all put down at once what they show at
    their first cell, whoever comes last stays, and only the few further cells and the few disputes are looked at one
    by one.
    """
    segments = _Segments.of(surface, dim)
    rows, columns = (cells + 1 if axis == dim else size for axis, size in enumerate(surface.part.shape))

    def counted(cell: Tensor, line: Tensor) -> Tensor:
        """Number of a cell of a line, all cells counted through; one at the end of each line is refuse."""
        return cell * columns + line if dim == 0 else line * columns + cell

    cell = segments.ahead + segments.whole
    claims = surface.connected & (segments.count >= 1)
    inside = cell.clamp(0, cells - 1)
    first = claims & (cell == inside)
    lines = torch.arange(columns if dim == 0 else rows, device=cell.device)
    slot = counted(inside.masked_fill_(~first, cells).long(), lines.view((1, -1) if dim == 0 else (-1, 1))).view(-1)
    shown = segments.show_first()
    held = Seen.of([_empty(values, rows * columns).scatter_(0, slot, values) for values in shown.tensors()])
    lost = (first.view(-1) & (held.height.index_select(0, slot) != shown.height)).nonzero()[:, 0]
    several = (claims & (segments.count >= 2)).view(-1).nonzero()[:, 0]
    which, further = _further_cells(cell.view(-1)[several], segments.count.view(-1)[several], cells)
    several = several[which]
    _settle(held, segments.show_further(several, further), counted(further, segments.line(several)))
    _settle(held, _taken(shown, lost), slot[lost])
    return Seen.of([values.view(rows, columns).narrow(dim, 0, cells) for values in held.tensors()])


@dataclass(frozen=True)
class _Segments:
    """The segments of a surface: where they begin, how long they are, and the first and the number of their cells.

    ``whole`` and ``index`` broadcast; the first cell is ``whole + ahead``.
    """

    surface: Surface
    dim: Literal[0, 1]
    whole: Tensor
    index: Tensor
    part: Tensor
    ahead: Tensor
    length: Tensor
    count: Tensor

    @classmethod
    def of(cls, surface: Surface, dim: Literal[0, 1]) -> "_Segments":
        """Those of a surface along an axis."""
        along = (-1, 1) if dim == 0 else (1, -1)
        whole, next_whole = _ends(surface.whole.view(along), dim)
        part, next_part = _ends(surface.part, dim)
        ahead, next_ahead = _ends(surface.part.ceil(), dim)
        gap = next_whole - whole
        length, count = (next_part - part).add_(gap), (next_ahead - ahead).add_(gap)
        index = torch.arange(len(surface.whole) - 1, dtype=part.dtype, device=part.device).view(along)
        return cls(surface, dim, whole, index, part, ahead, length, count)

    def show_first(self) -> Seen:
        """What every segment shows at its first cell, counted through."""
        fraction = _fraction(self.ahead - self.part, self.length)
        height, *carried = (torch.lerp(*_ends(values, self.dim), fraction) for values in self._values())
        seen = Seen(_places(self.index, fraction), height, tuple(carried), self.surface.measured)
        return Seen.of([values.view(-1) for values in seen.tensors()])

    def show_further(self, segment: Tensor, cell: Tensor) -> Seen:
        """What some segments, counted through, show at some cells."""
        index, samples = self._split(segment)[self.dim], self.surface.part.shape
        begin = segment if self.dim == 0 else segment + segment // (samples[1] - 1)
        end = begin + (samples[1] if self.dim == 0 else 1)

        def ends(values: Tensor) -> tuple[Tensor, Tensor]:
            return values.view(-1)[begin], values.view(-1)[end]

        whole = self.surface.whole[index]
        part, next_part = ends(self.surface.part)
        fraction = _fraction(cell - whole - part, next_part - part + (self.surface.whole[index + 1] - whole))
        height, *carried = (torch.lerp(*ends(values), fraction) for values in self._values())
        measured = self.surface.measured.view(-1)[segment]
        return Seen(_places(index.to(fraction.dtype), fraction), height, tuple(carried), measured)

    def line(self, segment: Tensor) -> Tensor:
        """The line that some segments, counted through, lie in."""
        return self._split(segment)[1 - self.dim]

    def _split(self, segment: Tensor) -> tuple[Tensor, Tensor]:
        columns = self.length.shape[1]
        return segment // columns, segment % columns

    def _values(self) -> tuple[Tensor, ...]:
        return self.surface.height, *self.surface.carried


def _ends(samples: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Values at the begin and at the end of every segment."""
    segments = samples.shape[dim] - 1
    return samples.narrow(dim, 0, segments), samples.narrow(dim, 1, segments)


def _empty(like: Tensor, size: int) -> Tensor:
    return like.new_full((size,), False if like.dtype == torch.bool else torch.nan)


def _fraction(distance: Tensor, length: Tensor) -> Tensor:
    """Distance over length, in place; 0..1 even where rounding lets a segment of no length cover a cell."""
    return distance.div_(length.clamp_(min=torch.finfo(length.dtype).eps)).clamp_(max=1.0)


def _places(index: Tensor, fraction: Tensor) -> Tensor:
    return (fraction * PIXEL_PARTS).round_().div_(PIXEL_PARTS).add_(index)


def _further_cells(first: Tensor, count: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """All cells but the first of segments, and which segment each belongs to."""
    begin = (first + 1).clamp_(min=0)
    times = (first + count).clamp_(max=cells).sub_(begin).clamp_(min=0).long()
    which = torch.arange(len(times), device=times.device).repeat_interleave(times)
    offset = torch.arange(len(which), device=times.device) - (times.cumsum(0) - times)[which]
    return which, begin.long()[which] + offset


def _taken(seen: Seen, where: Tensor) -> Seen:
    return Seen.of([values[where] for values in seen.tensors()])


def _settle(held: Seen, contenders: Seen, cell: Tensor) -> None:
    """Give cells, counted through ``held``, to the highest of their contenders and of who holds them; in place."""
    free = held.height[cell].isnan()
    _put(held, cell[free], _taken(contenders, free))
    left = held.height[cell] != contenders.height
    if not bool(left.any()):
        return
    contenders, cell = _taken(contenders, left), cell[left]
    disputed, which = torch.unique(cell, return_inverse=True)
    holder = held.height[disputed]
    highest = holder.scatter_reduce(0, which, contenders.height, "amax")
    order = torch.where(contenders.height == highest[which], torch.arange(len(which), device=which.device), -1)
    winner = torch.full_like(disputed, -1).scatter_reduce_(0, which, order, "amax")
    changes = highest > holder
    _put(held, disputed[changes], _taken(contenders, winner[changes]))


def _put(held: Seen, cell: Tensor, seen: Seen) -> None:
    for values, new in zip(held.tensors(), seen.tensors(), strict=True):
        values[cell] = new


def bridge_gaps(
    values: Float[Tensor, "lines samples"], *, longest: int, largest_step: float
) -> Float[Tensor, "lines samples"]:
    """Fill holes (NaN) of up to ``longest`` samples along each line linearly, where both ends belong together.

    Args:
        largest_step: largest change per sample between the ends; beyond it the hole hides a step and stays open.
    """
    known = ~values.isnan()
    line, begin = (known[:, 1:] != known[:, :-1]).nonzero(as_tuple=True)
    # A hole is a change followed by another in the same line, the first of which ends something known.
    holes = (line[1:] == line[:-1]) & known[line[:-1], begin[:-1]]
    line, begin, end = line[:-1][holes], begin[:-1][holes], begin[1:][holes] + 1
    span = end - begin
    low, high = values[line, begin], values[line, end]
    fits = (span <= longest + 1) & ((high - low).abs() <= largest_step * span)
    line, begin, span, low, high = (each[fits] for each in (line, begin, span, low, high))
    which = torch.arange(len(span), device=span.device).repeat_interleave(span - 1)
    step = torch.arange(1, 1 + len(which), device=span.device) - ((span - 1).cumsum(0) - (span - 1))[which]
    filled = values.clone()
    filled[line[which], begin[which] + step] = torch.lerp(low[which], high[which], step.to(values.dtype) / span[which])
    return filled
