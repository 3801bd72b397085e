"""What the right camera says about the left one's disparities: agreement, occlusion, and what may lie in the gaps."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_CODE = 4096.0  # a cost and a whole disparity share one float32 exactly
_NOBODY = 1e9


def agreeing(
    disparity: Float[Tensor, "lines width"], cost: Float[Tensor, "lines width"], limit_px: float
) -> Float[Tensor, "lines width"]:
    """Disparity without the pixels whose partner in the right image fits another pixel better.

    A pixel of the right image sees one surface. Of all pixels of the left one that claim it the one of least cost is
    right; those that differ from it by more than ``limit_px`` are not.

    Args:
        disparity: px, within ±2000, NaN for none.
        cost: at least 0 and at most 255, in whole numbers.
    """
    whole = torch.nan_to_num(disparity).round()
    partner, inside = _partner(disparity, whole)
    claim = torch.where(inside, cost * _CODE + whole + _CODE / 2, _NOBODY)
    best = torch.full_like(claim, _NOBODY).scatter_reduce_(1, partner, claim, "amin").gather(1, partner)
    winner = best.remainder(_CODE) - _CODE / 2
    return torch.where(inside & ((disparity - winner).abs() <= limit_px), disparity, torch.nan)


def occluded(disparity: Float[Tensor, "lines width"], limit_px: float = 1.0) -> Bool[Tensor, "lines width"]:
    """Which of the pixels without disparity lie behind something the right camera sees, rather than failed to match.

    A gap belongs to the surface behind it. Where the right camera sees a nearer one on the ray to that surface, the
    pixel is hidden; where it sees none, the match is what failed.

    Source: Hirschmüller 2008, section 2.6.
    """
    filled = fill_from_background(disparity)
    if filled is None:
        return torch.zeros_like(disparity, dtype=torch.bool)
    partner, inside = _partner(disparity, torch.nan_to_num(disparity).round())
    nearest = torch.where(inside, disparity, -_NOBODY)
    seen = torch.full_like(disparity, -_NOBODY).scatter_reduce_(1, partner, nearest, "amax")
    partner, inside = _partner(filled, filled.round())
    hidden = ~inside | (seen.gather(1, partner) > filled + limit_px)
    return disparity.isnan() & hidden


def fill_from_background(disparity: Float[Tensor, "lines width"]) -> Float[Tensor, "lines width"] | None:
    """Gaps filled with the farther of the disparities at their two ends; lines without any with the median of all.

    None where nothing is known.
    """
    known = disparity == disparity  # not NaN, in one pass
    if not bool(known.any()):
        return None
    width = disparity.shape[1]
    column = torch.arange(width)
    before = torch.where(known, column, -1).cummax(1).values
    after = torch.where(known, column, width).flip(1).cummin(1).values.flip(1)
    left = torch.where(before >= 0, disparity.gather(1, before.clamp(min=0)), torch.inf)
    right = torch.where(after < width, disparity.gather(1, after.clamp(max=width - 1)), torch.inf)
    filled = torch.minimum(left, right)
    empty = ~known.any(1)
    if bool(empty.any()):
        filled[empty] = disparity.nanmedian()
    return filled


def _partner(disparity: Tensor, whole: Tensor) -> tuple[Tensor, Tensor]:
    """Column of the right image, clamped to it, and whether there is one."""
    width = disparity.shape[1]
    column = torch.arange(width, dtype=whole.dtype) - whole
    inside = torch.isfinite(disparity) & (column >= 0) & (column < width)
    return column.clamp(0, width - 1).long(), inside
