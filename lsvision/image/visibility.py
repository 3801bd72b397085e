"""Which part of a surface, sampled along lines, is seen at each cell of a regular axis: a z-buffer in one dimension.

1. Neighbouring samples bound segments. Each covers the cells between its ends (``Segments``); segments that run
   backwards are seen from behind and are culled.
2. A segment interpolated at a cell is a fragment (``Seen``).
3. Every segment writes the fragment of its first cell to the buffer without a test, and the last one stays: nearly
   every segment covers one cell and nearly every cell is covered by one segment.
4. The remaining fragments, those of further cells and those that another one overwrote, pass a depth test against the
   buffer (``_depth_test``): the highest one wins, of equals the last.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.ragged import ragged_range
from lsvision.image.segments import Layout, Seen, Segments, Surface

__all__ = ["Seen", "Surface", "bridge_gaps", "see_cells"]


def see_cells(surface: Surface, cells: int, dim: Literal[0, 1]) -> Seen:
    """Interpolate a surface at the cells 0, 1, .., ``cells`` - 1 along an axis, each line for itself.

    Where several segments cover a cell, the highest one wins: a step or an overhang shows its nearer side. Of equals
    the last one wins. Segments that run backwards do not count.
    """
    layout, lines = Layout(dim), surface.part.shape[1 - dim]
    # Each line of the buffer ends with an extra cell, which takes the fragments that lie outside or are culled.
    rows, columns = (cells + 1, lines) if dim == 0 else (lines, cells + 1)
    segments = Segments.of(surface, layout)
    first, covers = segments.first, segments.covers(1)
    inside = first.clamp(0, cells - 1)
    drawn = covers & (first == inside)
    line = layout.across(torch.arange(lines, device=first.device))
    slot = layout.number(inside.masked_fill_(~drawn, cells).long(), line, columns).view(-1)
    fragments = segments.at_first_cells()
    buffer = fragments.rasterise(slot, rows * columns)
    overwritten = (drawn.view(-1) & (buffer.height.index_select(0, slot) != fragments.height)).nonzero()[:, 0]
    segment, further = segments.further_cells(cells)
    further_slot = layout.number(further, segments.line(segment), columns)
    _depth_test(buffer, segments.at_cells(segment, further), further_slot)
    _depth_test(buffer, fragments.select(overwritten), slot[overwritten])
    return Seen.of([values.view(rows, columns).narrow(dim, 0, cells) for values in buffer.tensors()])


def _depth_test(buffer: Seen, fragments: Seen, cell: Tensor) -> None:
    """Write each fragment that is higher than its cell in the buffer and all its rivals; in place.

    An empty cell takes any fragment; of equal fragments the last one is written, and none that only equals the buffer.
    """
    empty = buffer.height[cell].isnan()
    buffer.write(cell[empty], fragments.select(empty))
    different = buffer.height[cell] != fragments.height
    if not bool(different.any()):
        return
    rivals, cell = fragments.select(different), cell[different]
    contested, which = torch.unique(cell, return_inverse=True)
    stored = buffer.height[contested]
    highest = stored.scatter_reduce(0, which, rivals.height, "amax")
    order = torch.where(rivals.height == highest[which], torch.arange(len(which), device=which.device), -1)
    winner = torch.full_like(contested, -1).scatter_reduce_(0, which, order, "amax")
    higher = highest > stored
    buffer.write(contested[higher], rivals.select(winner[higher]))


def bridge_gaps(
    values: Float[Tensor, "lines samples"], *, longest: int, largest_step: float
) -> Float[Tensor, "lines samples"]:
    """Fill holes (NaN) of up to ``longest`` samples along each line linearly, where both ends belong together.

    Args:
        largest_step: largest change per sample between the ends; beyond it the hole hides a step and is not filled.
    """
    valid = ~values.isnan()
    line, begin = (valid[:, 1:] != valid[:, :-1]).nonzero(as_tuple=True)
    # A hole is a change from valid to invalid followed by another change in the same line.
    holes = (line[1:] == line[:-1]) & valid[line[:-1], begin[:-1]]
    line, begin, end = line[:-1][holes], begin[:-1][holes], begin[1:][holes] + 1
    span = end - begin
    low, high = values[line, begin], values[line, end]
    fits = (span <= longest + 1) & ((high - low).abs() <= largest_step * span)
    line, begin, span, low, high = (each[fits] for each in (line, begin, span, low, high))
    which, offset = ragged_range(span - 1)
    step = offset + 1
    filled = values.clone()
    filled[line[which], begin[which] + step] = torch.lerp(low[which], high[which], step.to(values.dtype) / span[which])
    return filled
