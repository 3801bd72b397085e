"""Which part of a surface, sampled along lines, is seen at each cell of a regular axis."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def visible_segments(
    position: Float[Tensor, "lines samples"],
    depth: Float[Tensor, "lines samples"],
    connected: Bool[Tensor, "lines samples-1"],
    cells: int,
) -> tuple[Int[Tensor, "lines {cells}"], Float[Tensor, "lines {cells}"]]:
    """Find, line by line, the segment between neighbouring samples that covers each integer cell.

    Segments that run backwards are seen from behind and do not count. Where several segments cover a cell, the one of
    least depth there wins: a step or an overhang shows its nearer side. Of equals the later one does.

    Args:
        position: coordinate of each sample on the axis, in cells; may be NaN.
        depth: orders surfaces, smaller is nearer.
        connected: whether the surface continues from a sample to the next; false across steps and beside holes.
        cells: number of cells, at 0, 1, .., cells - 1.

    Returns:
        Index i of the segment (i, i + 1) and the fraction 0..1 along it; -1 and NaN where nothing covers the cell.
    """
    following = position.ceil()
    first = following[:, :-1].clamp(min=0)
    count = torch.where(connected, following[:, 1:].clamp(max=cells) - first, 0.0)
    segment = _claimed_cells(position, depth, first, count, cells)
    start = segment.clamp(min=0)
    axis = torch.arange(cells, dtype=position.dtype, device=position.device)
    before, after = position.gather(1, start), position.gather(1, start + 1)
    return segment, torch.where(segment >= 0, (axis - before) / (after - before), torch.nan)


def _claimed_cells(position: Tensor, depth: Tensor, first: Tensor, count: Tensor, cells: int) -> Tensor:
    """Winning segment of every cell, -1 for none, of segments that cover ``count`` cells from ``first`` on.

    Nearly every segment covers one cell and nearly every cell one segment. So all claim their first cell at once,
    whoever comes last keeps it, and only the few further cells and the few disputes are looked at one by one.
    """
    lines, segments = first.shape
    index = torch.arange(segments, device=first.device).expand(lines, segments)
    claims = count > 0
    cell = torch.where(claims, first, float(cells)).long()
    held = torch.full((lines, cells + 1), -1, dtype=torch.long, device=first.device)  # the last column is refuse
    held.scatter_(1, cell, index)

    line, begin = (count > 1).nonzero().unbind(1)
    times = count[line, begin].long() - 1
    offset = torch.arange(1, 1 + int(times.sum()), device=first.device)
    offset = offset - (times.cumsum(0) - times).repeat_interleave(times)
    line, begin = line.repeat_interleave(times), begin.repeat_interleave(times)
    further = cell[line, begin] + offset
    held[line, further] = begin

    lost = claims & (held.gather(1, cell) != index)
    lost_line, lost_segment = lost.nonzero().unbind(1)
    also = held[line, further] != begin
    disputes = [
        torch.cat([lost_line, line[also]]),
        torch.cat([lost_segment, begin[also]]),
        torch.cat([cell[lost_line, lost_segment], further[also]]),
    ]
    if disputes[0].numel():
        _settle(held, position, depth, *disputes)
    return held[:, :cells]


def _settle(held: Tensor, position: Tensor, depth: Tensor, line: Tensor, segment: Tensor, cell: Tensor) -> None:
    """Give every disputed cell to the nearest of its present holder and the segments that lost it; in place."""
    disputed, which = torch.unique(line * held.shape[1] + cell, return_inverse=True)
    holder = held.view(-1)[disputed]
    line = torch.cat([line, disputed // held.shape[1]])
    segment = torch.cat([segment, holder])
    cell = torch.cat([cell, disputed % held.shape[1]])
    which = torch.cat([which, torch.arange(disputed.numel(), device=held.device)])
    low, high = position[line, segment], position[line, segment + 1]
    seen = torch.lerp(depth[line, segment], depth[line, segment + 1], ((cell - low) / (high - low)).to(depth.dtype))
    nearest = torch.full_like(disputed, torch.inf, dtype=seen.dtype).scatter_reduce_(0, which, seen, "amin")
    wins = torch.where(seen == nearest[which], segment, -1)
    held.view(-1)[disputed] = torch.full_like(disputed, -1).scatter_reduce_(0, which, wins, "amax")


def interpolate_segments(
    values: Float[Tensor, "lines samples"], segment: Int[Tensor, "lines cells"], fraction: Float[Tensor, "lines cells"]
) -> Float[Tensor, "lines cells"]:
    """Values at a fraction along segments; NaN where that is NaN."""
    start = segment.clamp(min=0)
    return torch.lerp(values.gather(1, start), values.gather(1, start + 1), fraction.to(values.dtype))


def both_ends(flags: Bool[Tensor, "lines samples"], segment: Int[Tensor, "lines cells"]) -> Bool[Tensor, "lines cells"]:
    """Whether both samples of a cell's segment carry a flag; false where there is no segment."""
    start = segment.clamp(min=0)
    return flags.gather(1, start) & flags.gather(1, start + 1) & (segment >= 0)


def bridge_gaps(
    values: Float[Tensor, "lines samples"], *, longest: int, largest_step: float
) -> Float[Tensor, "lines samples"]:
    """Fill holes (NaN) of up to ``longest`` samples along each line linearly, where both ends belong together.

    Args:
        largest_step: largest change per sample between the ends; beyond it the hole hides a step and stays open.
    """
    known = ~values.isnan()
    if bool(known.all()):
        return values
    samples = values.shape[1]
    index = torch.arange(samples, device=values.device).expand(values.shape)
    before = torch.where(known, index, -1).cummax(1).values
    after = torch.where(known, index, samples).flip(1).cummin(1).values.flip(1)
    span = after - before
    begin, end = values.gather(1, before.clamp(min=0)), values.gather(1, after.clamp(max=samples - 1))
    fits = (before >= 0) & (after < samples) & (span <= longest + 1) & ((end - begin).abs() <= largest_step * span)
    filled = torch.lerp(begin, end, (index - before).to(values.dtype) / span.clamp(min=1))
    return torch.where(known, values, torch.where(fits, filled, torch.nan))
