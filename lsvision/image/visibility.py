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
    least depth there wins: a step or an overhang shows its nearer side.

    Args:
        position: coordinate of each sample on the axis, in cells; may be NaN.
        depth: orders surfaces, smaller is nearer.
        connected: whether the surface continues from a sample to the next; false across steps and beside holes.
        cells: number of cells, at 0, 1, .., cells - 1.

    Returns:
        Index i of the segment (i, i + 1), -1 where nothing covers the cell, and the fraction 0..1 along it.
    """
    lines = position.shape[0]
    low, high = position[:, :-1], position[:, 1:]
    usable = connected & (high > low) & (high > 0) & (low < cells)
    first = torch.where(usable, low, 0.0).clamp(min=0).ceil()
    count = torch.where(usable, (high.clamp(max=cells) - first).ceil(), 0.0)
    most = int(count.max()) if count.numel() else 0
    segment = torch.full((lines, cells), -1, dtype=torch.long, device=position.device)
    if most == 0:
        return segment, torch.zeros_like(position[:, :1]).expand(lines, cells)

    # A segment covers at most `most` cells, one or two as a rule: each candidate bids for its cell with its depth.
    offset = torch.arange(most, device=position.device)
    bids = offset < count[..., None]
    cell = torch.where(bids, first[..., None].long() + offset, cells).flatten(1)
    fraction = ((first[..., None] + offset - low[..., None]) / (high - low)[..., None]).flatten(1)
    begin, end = (side[..., None].expand(bids.shape).flatten(1) for side in (depth[:, :-1], depth[:, 1:]))
    bid_depth = torch.lerp(begin, end, fraction)
    bid_depth = torch.where(bids.flatten(1), bid_depth, torch.inf)
    nearest = torch.full((lines, cells + 1), torch.inf, dtype=depth.dtype, device=depth.device)
    nearest.scatter_reduce_(1, cell, bid_depth, "amin")
    wins = bids.flatten(1) & (bid_depth == nearest.gather(1, cell))

    # Equal bids: the later segment, so that the result does not depend on the order of the scatter.
    index = torch.arange(low.shape[1], device=position.device)[:, None].expand(-1, most).reshape(1, -1).expand_as(cell)
    padded = torch.nn.functional.pad(segment, (0, 1), value=-1)
    padded.scatter_reduce_(1, torch.where(wins, cell, cells), torch.where(wins, index, -1), "amax")
    segment = padded[:, :cells]
    start = segment.clamp(min=0)
    axis = torch.arange(cells, dtype=position.dtype, device=position.device)
    before, after = position.gather(1, start), position.gather(1, start + 1)
    return segment, torch.where(segment >= 0, (axis - before) / (after - before), 0.0)


def interpolate_segments(
    values: Float[Tensor, "lines samples"], segment: Int[Tensor, "lines cells"], fraction: Float[Tensor, "lines cells"]
) -> Float[Tensor, "lines cells"]:
    """Values at a fraction along segments, NaN where there is none."""
    start = segment.clamp(min=0)
    blended = torch.lerp(values.gather(1, start), values.gather(1, start + 1), fraction.to(values.dtype))
    return torch.where(segment >= 0, blended, torch.nan)


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
    samples = values.shape[1]
    index = torch.arange(samples, device=values.device).expand(values.shape)
    known = torch.isfinite(values)
    before = torch.where(known, index, -1).cummax(1).values
    after = torch.where(known, index, samples).flip(1).cummin(1).values.flip(1)
    span = after - before
    begin, end = values.gather(1, before.clamp(min=0)), values.gather(1, after.clamp(max=samples - 1))
    fits = (before >= 0) & (after < samples) & (span <= longest + 1) & ((end - begin).abs() <= largest_step * span)
    filled = torch.lerp(begin, end, (index - before).to(values.dtype) / span.clamp(min=1))
    return torch.where(known, values, torch.where(fits, filled, torch.nan))
