"""Dense stereo matching from coarse to fine: the whole range on a small copy, a few disparities on a larger one.

A quarter of the size holds a sixteenth of the pixels and a quarter of the disparities. On smooth ground what it finds,
refined, is good to half a pixel of its own, within reach of the refinement at half the size. Where that leaves more
than noise, where the small copy found nothing, and beside an edge, where blocks see two surfaces, the nearest and the
farthest surface around are both searched for at half the size, and what fits best stays. What is left to find,
fractions of a pixel, is the work of ``refine_disparity``.
"""

import math
from typing import Any

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from lsvision.image.brightness import gray_bytes, white_level
from lsvision.image.stereo.agreement import agreeing, fill_from_background
from lsvision.image.stereo.refine import refine_disparity
from lsvision.image.stereo.sgbm import check_pair, run_sgbm, sgbm_matcher
from lsvision.types import TensorImage

BLOCK = 2  # pixels along the side of the blocks that get a disparity
COARSEST = 4  # size of the full image over that of the smallest copy; strips should start at multiples of it
_AROUND = (-8, 7)  # disparities tried around the coarse one, px of half the size
# Surfaces that differ by less over a neighbourhood of the small copy, px of it, are within reach of one search.
_TWO_SURFACES_PX = 5.0
_NEIGHBOURHOOD = 5
_ROOM_PX = 64
_SMOOTH_PX = 2.0  # a larger step between neighbours is an edge, over which nothing is interpolated
_COARSE_SPECKLE = 2  # times the pixels of a speckle: what is removed here is found again at half the size
# The small copy is in doubt where its refinement leaves residuals over noise that a shift by less, px of half the size,
# does not explain, in more than so many of 255 parts of a neighbourhood.
_DOUBTFUL_PX = 0.45
_DOUBT_BLOCK, _DOUBT_LEVEL = 9, 48
_WINDOW, _COARSE_WINDOW = 9, 7  # of the refinement
_COST_BLOCK, _COST_LIMIT, _NO_MATCH = 5, 60, 255.0


def match_coarse_to_fine(
    left: Tensor,
    right: Tensor,
    *,
    minimum_px: int,
    maximum_px: int,
    block_size: int,
    lambda1: float,
    lambda2: float,
    left_right_check_px: int,
    fine_check_px: int,
    uniqueness_percent: int,
    speckle_px: int,
    noise: float,
    white: float | None = None,
) -> Float[Tensor, "rows columns"]:
    """Disparity u_left - u_right of each 2 x 2 pixels of a pair of strips, the last ones perhaps incomplete.

    In pixels of the full size, float32, and good to a fifth of one; NaN for no match. ``refine_disparity`` takes it.

    Args:
        left, right: as in ``match_sgbm``, as are the range, the block, the penalties and ``white``.
        left_right_check_px, uniqueness_percent: on the small copy, the former in full pixels.
        fine_check_px: largest disagreement at half the size, in full pixels.
        speckle_px: smaller patches are removed, in pixels of half the size.
        noise: standard deviation of the grey values, of 255.

    Raises:
        ValueError: shapes differ or the range is empty.

    Source: Hirschmüller 2008, as ``match_sgbm``, over a pyramid as in Rothermel et al. 2012, SURE.
    """
    check_pair(left, right, minimum_px, maximum_px)
    white = white or white_level(TensorImage(left), TensorImage(right))
    penalties = round(lambda1 * block_size**2), round(lambda2 * block_size**2)
    lines, width, _ = left.shape
    (half_left, left_4), (half_right, right_4) = (_reduced(gray_bytes(image, white)) for image in (left, right))
    low, high = math.floor(minimum_px / COARSEST), math.ceil(maximum_px / COARSEST)
    check = round(left_right_check_px / COARSEST)
    speckle = _COARSE_SPECKLE * speckle_px
    matcher = sgbm_matcher((low, high), block_size, penalties, check, uniqueness_percent, speckle)
    coarse = run_sgbm(matcher, left_4, right_4, high)
    coarse = refine_disparity(left_4, right_4, coarse, window=_COARSE_WINDOW, iterations=1, noise=noise).disparity
    filled = fill_from_background(coarse)
    if filled is None:
        return left.new_full((-(-lines // BLOCK), -(-width // BLOCK)), torch.nan, dtype=torch.float32)
    near, far = _surfaces(filled)
    # What is searched for is steep or small: changes cost less than at a quarter of the size. No check is asked of the
    # search itself, since ``agreeing`` compares what all of them found.
    steps = _AROUND[1] - _AROUND[0] + 1
    matcher = sgbm_matcher(_AROUND, block_size, (penalties[0] // 2, penalties[1]), steps, 0, 0)
    checks = speckle_px, fine_check_px / 2
    disparity = _at_half_size(matcher, half_left, half_right, (near, far), coarse.isnan(), checks, noise)
    disparity = disparity[: -(-lines // BLOCK), : -(-width // BLOCK)].mul(BLOCK)
    return _within(disparity, minimum_px, maximum_px, width)


def _at_half_size(
    matcher: cv2.StereoSGBM,
    left: Tensor,
    right: Tensor,
    surfaces: tuple[Tensor, Tensor],
    missing: Tensor,
    checks: tuple[int, float],
    noise: float,
) -> Tensor:
    """Refined disparity at half the size, searched for only where the small copy is in doubt.

    The doubt follows from the surroundings of a pixel alone, so that the result does not depend on the strip.
    """
    (near, far), (speckle_px, limit_px) = surfaces, checks
    options: dict[str, Any] = {"window": _WINDOW, "iterations": 1, "noise": noise}
    disparity = refine_disparity(left, right, near, **options, largest_sigma_px=_DOUBTFUL_PX / _WINDOW).disparity
    wrong, two = disparity.isnan(), near > far
    disparity = torch.where(wrong, near, disparity)
    cost = _misfit(left, right, disparity, slice(0, near.shape[1]))
    doubtful = _around(wrong | two | _repeated(missing, COARSEST // BLOCK))
    for base, where in ((near, doubtful), (far, two)):
        for columns in _stretches(where.any(0)):
            found = _match_around(matcher, left, right, base, columns)
            misfit = _misfit(left, right, found, columns)
            better = (misfit < cost[:, columns]).logical_and_(where[:, columns])
            disparity[:, columns] = torch.where(better, found, disparity[:, columns])
            cost[:, columns] = torch.where(better, misfit, cost[:, columns])
    disparity = agreeing(_without_speckles(disparity, speckle_px), cost, limit_px)
    for columns in _stretches(doubtful.any(0)):
        part, start = disparity[:, columns], columns.start
        refined = refine_disparity(left[:, columns], right, part, first_column=start, **options).disparity
        disparity[:, columns] = torch.where(doubtful[:, columns], refined, part)
    return disparity


def _within(disparity: Tensor, minimum_px: int, maximum_px: int, width: int) -> Tensor:
    """Disparity of blocks without what lies beyond the range or has its partner beyond the image, ``width`` px wide."""
    partner = BLOCK * torch.arange(disparity.shape[1]) + (BLOCK - 1) / 2 - disparity
    # Both columns of a block; the lowest partner is 0, the highest width - 1.
    seen = (partner - (width - 1) / 2).abs_() <= (width - BLOCK) / 2
    in_range = (disparity > minimum_px - 1) & (disparity < maximum_px + 1)
    return torch.where(seen & in_range, disparity, torch.nan)


def _reduced(image: Tensor) -> tuple[Tensor, Tensor]:
    """Copies of half and of a quarter of the size, by averages; an incomplete last block repeats the edge."""
    lines, width = image.shape
    whole = cv2.copyMakeBorder(image.numpy(), 0, -lines % COARSEST, 0, -width % COARSEST, cv2.BORDER_REPLICATE)
    copies = (cv2.resize(whole, None, fx=1 / k, fy=1 / k, interpolation=cv2.INTER_AREA) for k in (2, COARSEST))
    half, quarter = (torch.from_numpy(copy) for copy in copies)
    return half, quarter


def _surfaces(coarse: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest and the farthest surface around each pixel at half the size, one where they are within reach."""
    middle = cv2.medianBlur(coarse.numpy(), 5)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (_NEIGHBOURHOOD, _NEIGHBOURHOOD))
    near, far, middle = (torch.from_numpy(x) for x in (cv2.dilate(middle, kernel), cv2.erode(middle, kernel), middle))
    one = near - far < _TWO_SURFACES_PX
    size = 2 * coarse.shape[0], 2 * coarse.shape[1]
    near, far = (_enlarged(2 * torch.where(one, middle, surface), size) for surface in (near, far))
    return near, far


def _around(where: Tensor) -> Tensor:
    """Pixels where a good part of a small neighbourhood is marked, and those near such pixels."""
    marked = where.to(torch.uint8).mul_(255).numpy()
    dense = cv2.threshold(cv2.blur(marked, (_DOUBT_BLOCK, _DOUBT_BLOCK)), _DOUBT_LEVEL, 255, cv2.THRESH_BINARY)[1]
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * _DOUBT_BLOCK + 1, 2 * _DOUBT_BLOCK + 1))
    return torch.from_numpy(cv2.dilate(dense, kernel)) > 0


def _repeated(mask: Tensor, times: int) -> Tensor:
    return mask.repeat_interleave(times, 0).repeat_interleave(times, 1)


def _stretches(columns: Tensor) -> list[slice]:
    """Stretches of marked columns with room for a search on either side."""
    wide = F.max_pool1d(columns.float()[None], 2 * _ROOM_PX + 1, 1, _ROOM_PX)[0]
    bounds = F.pad(wide, (1, 1)).diff().nonzero()[:, 0].view(-1, 2)
    return [slice(start, stop) for start, stop in bounds.tolist()]


def _match_around(matcher: cv2.StereoSGBM, left: Tensor, right: Tensor, base: Tensor, columns: slice) -> Tensor:
    """Disparity in some columns by a search around a base."""
    base = base[:, columns]
    column = torch.arange(columns.start, columns.stop, dtype=torch.float32)
    disparity = base + run_sgbm(matcher, left[:, columns], _sampled(right, column - base), _AROUND[1])
    partner = column - disparity
    return torch.where((partner > -0.5) & (partner < right.shape[1] - 0.5), disparity, torch.nan)


def _misfit(left: Tensor, right: Tensor, disparity: Tensor, columns: slice) -> Tensor:
    """How badly the disparity of some columns fits: mean absolute difference over a block."""
    partner = torch.arange(columns.start, columns.stop, dtype=torch.float32) - disparity
    difference = cv2.absdiff(_sampled(right, torch.nan_to_num(partner)).numpy(), left[:, columns].numpy())
    cost = torch.from_numpy(cv2.blur(difference.clip(max=_COST_LIMIT), (_COST_BLOCK, _COST_BLOCK))).to(torch.float32)
    return torch.where(disparity.isnan(), _NO_MATCH, cost)


def _sampled(image: Tensor, column: Tensor) -> Tensor:
    """Values of an image at fractional columns of each line."""
    line = torch.arange(column.shape[0], dtype=torch.float32)[:, None].expand_as(column).contiguous()
    sampled = cv2.remap(image.numpy(), column.numpy(), line.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(sampled)


def _without_speckles(disparity: Tensor, size: int) -> Tensor:
    """Disparity without patches of fewer pixels than ``size``, set apart by steps of more than a pixel."""
    steps, missing = 16, -32768
    scaled = torch.nan_to_num(steps * disparity, nan=missing).clamp(missing, -missing - 1).to(torch.int16)
    cv2.filterSpeckles(scaled.numpy(), missing, size, steps)
    return torch.where(scaled == missing, torch.nan, disparity)


def _enlarged(disparity: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolated between pixels of one surface, taken from the nearest beside an edge; NaN stays NaN."""
    shape = size[1], size[0]
    nearest = torch.from_numpy(cv2.resize(disparity.numpy(), shape, interpolation=cv2.INTER_NEAREST))
    filled = fill_from_background(disparity)
    if filled is None:
        return nearest
    smooth = torch.from_numpy(cv2.resize(filled.numpy(), shape, interpolation=cv2.INTER_LINEAR))
    # A comparison with NaN is false: what is missing stays.
    return torch.where((smooth - nearest).abs() < _SMOOTH_PX, smooth, nearest)
