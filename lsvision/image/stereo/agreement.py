"""Consistency of the left view's disparities with the right view: agreement, occlusion, and filling of gaps."""

import functools

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.tiling import by_rows

_DISPARITIES = 4096  # cost and whole disparity are coded as one integer: cost * 4096 + 2048 + disparity
_NO_CLAIM = 2**30


def agreeing(
    disparity: Float[Tensor, "lines width"], cost: Float[Tensor, "lines width"], limit_px: float
) -> Float[Tensor, "lines width"]:
    """Disparity without the pixels whose partner in the right image fits another pixel better.

    A pixel of the right image sees one surface. Of all pixels of the left one that claim it the one of least cost is
    right; those whose disparity differs from it by more than ``limit_px`` are wrong.

    Args:
        disparity: px, within ±2000, NaN for none.
        cost: whole numbers from 0 to 255.
    """
    return by_rows(functools.partial(_agreeing_rows, limit_px=limit_px), disparity, cost)


def _agreeing_rows(disparity: Tensor, cost: Tensor, limit_px: float) -> Tensor:
    whole = torch.nan_to_num(disparity).round()
    partner, inside = _partner(disparity, whole)
    claim = torch.where(inside, torch.add(whole, cost, alpha=_DISPARITIES).add_(_DISPARITIES / 2), _NO_CLAIM).to(
        torch.int32
    )
    best = torch.full_like(claim, _NO_CLAIM).scatter_reduce_(1, partner, claim, "amin").gather(1, partner)
    winner = best.bitwise_and_(_DISPARITIES - 1).sub_(_DISPARITIES // 2)
    return torch.where(((disparity - winner).abs_() <= limit_px).logical_and_(inside), disparity, torch.nan)


def occluded(disparity: Float[Tensor, "lines width"], limit_px: float = 1.0) -> Bool[Tensor, "lines width"]:
    """Which of the pixels without disparity are hidden from the right camera, rather than failed to match.

    A gap belongs to the surface behind it. Where the right camera sees a nearer surface on the ray to that one, the
    pixel is hidden; elsewhere matching failed.

    Source: Hirschmüller 2008, section 2.6.
    """
    filled = fill_from_background(disparity)
    if filled is None:
        return torch.zeros_like(disparity, dtype=torch.bool)
    partner, inside = _partner(disparity, torch.nan_to_num(disparity).round())
    nearest = torch.where(inside, disparity, -_NO_CLAIM)
    seen = torch.full_like(disparity, -_NO_CLAIM).scatter_reduce_(1, partner, nearest, "amax")
    partner, inside = _partner(filled, filled.round())
    hidden = ~inside | (seen.gather(1, partner) > filled + limit_px)
    return disparity.isnan() & hidden


def fill_from_background(disparity: Float[Tensor, "lines width"]) -> Float[Tensor, "lines width"] | None:
    """Fill gaps with the farther of the disparities at their two ends, and empty lines with the median of all.

    Returns:
        None where no pixel has a disparity.
    """
    # Ends without a valid neighbour refer to a column of infinity on either side, so that no gap reaches another line.
    padded = F.pad(disparity, (1, 1), value=torch.inf)
    values = padded.view(-1).numpy()
    valid = values == values  # not NaN
    if valid.all():
        return disparity
    empty = ~torch.from_numpy(valid.reshape(padded.shape)[:, 1:-1].any(1))
    if bool(empty.all()):
        return None
    before, after = (np.flatnonzero(valid[:-1] > valid[1:]), np.flatnonzero(valid[:-1] < valid[1:]) + 1)
    values[~valid] = np.repeat(np.minimum(values[before], values[after]), after - before - 1)
    filled = padded[:, 1:-1].contiguous()
    if bool(empty.any()):
        filled[empty] = disparity.nanmedian()
    return filled


def _partner(disparity: Tensor, whole: Tensor) -> tuple[Tensor, Tensor]:
    """Column of the partner in the right image, clamped to it, and whether it lies inside."""
    width = disparity.shape[1]
    column = torch.arange(width, dtype=whole.dtype) - whole
    inside = (disparity == disparity) & (column >= 0) & (column < width)
    return column.clamp(0, width - 1).long(), inside
