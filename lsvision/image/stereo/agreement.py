"""What the right camera says about the left one's disparities: agreement, occlusion, and what may lie in the gaps."""

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

_CODE = 4096  # a cost and a whole disparity share one integer
_NOBODY = 2**30


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
    claim = torch.where(inside, torch.add(whole, cost, alpha=_CODE).add_(_CODE / 2), _NOBODY).to(torch.int32)
    best = torch.full_like(claim, _NOBODY).scatter_reduce_(1, partner, claim, "amin").gather(1, partner)
    winner = best.bitwise_and_(_CODE - 1).sub_(_CODE // 2)
    return torch.where(((disparity - winner).abs_() <= limit_px).logical_and_(inside), disparity, torch.nan)


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
    known = (disparity == disparity).numpy()  # not NaN
    if known.all():
        return disparity
    if not known.any():
        return None
    width = disparity.shape[1]
    column = np.arange(width, dtype=np.int32)
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    # A column of infinity on either side is what the ends of a line without a neighbour refer to.
    padded = F.pad(disparity, (1, 1), value=torch.inf)
    left, right = (padded.gather(1, torch.from_numpy(end + np.int64(1))) for end in (before, after))
    filled = torch.minimum(left, right)
    empty = torch.from_numpy(~known.any(1))
    if bool(empty.any()):
        filled[empty] = disparity.nanmedian()
    return filled


def _partner(disparity: Tensor, whole: Tensor) -> tuple[Tensor, Tensor]:
    """Column of the right image, clamped to it, and whether there is one."""
    width = disparity.shape[1]
    column = torch.arange(width, dtype=whole.dtype) - whole
    inside = torch.isfinite(disparity) & (column >= 0) & (column < width)
    return column.clamp(0, width - 1).long(), inside
