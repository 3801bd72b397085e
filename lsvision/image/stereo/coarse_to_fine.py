"""Dense stereo matching from coarse to fine: the whole range on a small copy, a few disparities on a larger one.

1. ``_reduced``: both images are shrunk to a half and to a quarter of their size.
2. ``_search_quarter``: the whole range is searched at a quarter of the size, which holds a sixteenth of the pixels and
   a quarter of the disparities. On smooth ground the refined result is good to half a pixel of the quarter, within
   reach of a refinement at half the size.
3. ``_surfaces_around``: the quarter gives the nearest and the farthest surface around each pixel of the half.
4. ``_search_half``: the nearest surface is refined at half the size. Pixels are in doubt where this leaves residuals
   above noise, where the quarter has no match, and beside an edge, where a block sees two surfaces. There both surfaces
   are searched around (``BestMatch.search_around``), the disparity that fits best is kept, pixels that contradict the
   right view are dropped (``agreeing``), and the others are refined.
5. ``_within_range``: disparities outside of the range or of the right image are dropped.

The remaining fractions of a pixel are the task of ``refine_disparity`` at full size.
"""

from dataclasses import dataclass, replace

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.stereo.agreement import agreeing, fill_from_background
from lsvision.image.stereo.best_match import BestMatch, stretches
from lsvision.image.stereo.blocks import enlarged, repeated
from lsvision.image.stereo.refine import RefineOptions, refine_disparity
from lsvision.image.stereo.seen_rows import SeenRows
from lsvision.image.stereo.sgbm import GrayPair, Search, match_sgbm
from lsvision.image.tiling import by_rows

BLOCK = 2  # pixels along the side of the blocks that get a disparity
COARSEST = 4  # size of the full image over that of the smallest copy; strips should start at multiples of it
_AROUND = (-8, 7)  # disparities searched around a surface, px of half the size
# Surfaces that differ by less over a neighbourhood of the quarter, px of it, are within reach of one search.
_TWO_SURFACES_PX = 5.0
_MEDIAN, _NEIGHBOURHOOD = 5, 5
_EDGE_PX = 2.0  # a larger step between neighbours is an edge, over which nothing is interpolated
_COARSE_SPECKLE = 2  # times the pixels of a speckle: a pixel removed from the quarter is searched again in the half
# The residual of the refinement is above noise where no shift by less than this, px of half the size, explains it. A
# pixel is in doubt where this holds for more than the level, of 255, of the block around it.
_DOUBTFUL_PX = 0.45
_DOUBT_BLOCK, _DOUBT_LEVEL = 9, 48
_HALF_WINDOW, _QUARTER_WINDOW = 9, 7  # of the refinement


def match_coarse_to_fine(
    pair: GrayPair, search: Search, *, fine_check_px: int, noise: float, seen: SeenRows | None = None
) -> Float[Tensor, "rows columns"]:
    """Disparity u_left - u_right of each 2 x 2 pixels of a pair of strips, the last ones perhaps incomplete.

    In pixels of the full size, float32, and good to a fifth of one; NaN for no match. ``refine_disparity`` improves it.

    Args:
        search: in pixels of the full size, but ``block_size`` in those of either copy and ``speckle_px`` in those of
            the half. ``left_right_check_px`` and ``uniqueness_percent`` hold for the quarter.
        fine_check_px: largest disagreement of the two views in the half, px of the full size.
        noise: sigma of the noise of grey values, of 255.
        seen: the rows that both images show, in each column; None for all.

    Source: Hirschmüller 2008, as ``match_sgbm``, over a pyramid as in Rothermel et al. 2012, SURE.
    """
    lines, width = pair.left.shape
    rows, columns = -(-lines // BLOCK), -(-width // BLOCK)
    coarse = _search_quarter(_reduced(pair, COARSEST), search, noise)
    coarse = coarse if seen is None else seen.extended(coarse, COARSEST)
    filled = fill_from_background(coarse)
    if filled is None:
        return torch.full((rows, columns), torch.nan)
    surfaces = _surfaces_around(filled, repeated(coarse, COARSEST // BLOCK).isnan(), seen)
    disparity = _search_half(_reduced(pair, BLOCK), surfaces, search, fine_check_px / BLOCK, noise)
    return _within_range(disparity[:rows, :columns].mul(BLOCK), search, width)


def _reduced(pair: GrayPair, size: int) -> GrayPair:
    """A copy ``size`` times smaller, by averages; incomplete last blocks of the smallest copy repeat the edge."""
    lines, width = pair.left.shape

    def reduced(image: Tensor) -> Tensor:
        # Instead of kornia's pyrdown, another filter (a 5 x 5 Gaussian), which takes 970 times as long.
        whole = cv2.copyMakeBorder(image.numpy(), 0, -lines % COARSEST, 0, -width % COARSEST, cv2.BORDER_REPLICATE)
        return torch.from_numpy(cv2.resize(whole, None, fx=1 / size, fy=1 / size, interpolation=cv2.INTER_AREA))

    return GrayPair(reduced(pair.left), reduced(pair.right))


def _search_quarter(quarter: GrayPair, search: Search, noise: float) -> Tensor:
    """Refined disparity over the whole range at a quarter of the size."""
    coarse_search = replace(search.reduced(COARSEST), speckle_px=_COARSE_SPECKLE * search.speckle_px)
    options = RefineOptions(_QUARTER_WINDOW, iterations=1, noise=noise, with_sigma=False)
    return refine_disparity(quarter.left, quarter.right, match_sgbm(quarter, coarse_search), options).disparity


@dataclass(frozen=True)
class _Surfaces:
    """Disparity of the nearest and the farthest surface around each pixel; the same where one search reaches both.

    ``missing`` is where the quarter has no match, ``beyond`` where one of the images shows nothing; None for nowhere.
    """

    near: Tensor
    far: Tensor
    missing: Tensor
    beyond: Tensor | None

    def doubtful(self, near: Tensor) -> Tensor:
        """Where a search is needed, from the refined disparity of the nearest surface, NaN where it is wrong."""
        doubt = near.isnan() | (self.near > self.far) | self.missing
        if self.beyond is None:
            return _grown(doubt)
        return _grown(doubt & ~self.beyond) & ~self.beyond


def _surfaces_around(coarse: Tensor, missing: Tensor, seen: SeenRows | None) -> _Surfaces:
    """Surfaces around each pixel of the half, px of it, from the disparity of the quarter without gaps.

    Args:
        missing: where the quarter has no match. seen: the rows that both images show.
    """
    middle = cv2.medianBlur(coarse.numpy(), _MEDIAN)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (_NEIGHBOURHOOD, _NEIGHBOURHOOD))
    near, far, middle = (torch.from_numpy(x) for x in (cv2.dilate(middle, kernel), cv2.erode(middle, kernel), middle))
    one = near - far < _TWO_SURFACES_PX
    near, far = (enlarged(2 * torch.where(one, middle, surface), 2, _EDGE_PX) for surface in (near, far))
    beyond = None if seen is None else seen.beyond(near, BLOCK, _HALF_WINDOW // 2)
    return _Surfaces(near, far, missing, beyond)


def _search_half(half: GrayPair, surfaces: _Surfaces, search: Search, check_px: float, noise: float) -> Tensor:
    """Refined disparity at half the size, searched for only where the surfaces are in doubt.

    The doubt follows from the surroundings of a pixel alone, so that the result does not depend on the strip.

    Args:
        check_px: largest disagreement of the two views.
    """
    options = RefineOptions(_HALF_WINDOW, iterations=1, noise=noise, with_sigma=False)
    doubting = replace(options, largest_misfit_px=_DOUBTFUL_PX / _HALF_WINDOW)
    near = refine_disparity(half.left, half.right, surfaces.near, doubting).disparity
    doubtful = surfaces.doubtful(near)
    best = BestMatch.of(half, torch.where(near.isnan(), surfaces.near, near))
    around = _search_around(search)
    best.search_around(surfaces.near, doubtful, around)
    best.search_around(surfaces.far, doubtful & (surfaces.near > surfaces.far), around)
    disparity = agreeing(without_speckles(best.disparity, search.speckle_px), best.cost, check_px)
    return _refined_where(half, disparity, doubtful, options)


def _search_around(search: Search) -> Search:
    """The search around a surface, px of half the size.

    Disparities around a surface belong to steep or small objects: changes cost less than in the quarter. Views are not
    compared in each search, since ``agreeing`` compares the best of all searches.
    """
    low, high = _AROUND
    return Search(
        minimum_px=low,
        maximum_px=high,
        block_size=search.block_size,
        small_change_penalty=search.small_change_penalty // 2,
        large_change_penalty=search.large_change_penalty,
        left_right_check_px=high - low + 1,
        uniqueness_percent=0,
        speckle_px=0,
        beyond_px=0,  # the surface is known, and 16 disparities cost half of 32
    )


def _grown(marked: Tensor) -> Tensor:
    """Pixels where a good part of a small neighbourhood is marked, and those near such pixels."""
    marked_bytes = marked.to(torch.uint8).mul_(255).numpy()
    share = cv2.blur(marked_bytes, (_DOUBT_BLOCK, _DOUBT_BLOCK))
    dense = cv2.threshold(share, _DOUBT_LEVEL, 255, cv2.THRESH_BINARY)[1]
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * _DOUBT_BLOCK + 1, 2 * _DOUBT_BLOCK + 1))
    return torch.from_numpy(cv2.dilate(dense, kernel)) > 0


def without_speckles(disparity: Tensor, size: int) -> Tensor:
    """Disparity without patches of fewer pixels than ``size``; steps of more than a pixel separate patches."""
    steps, missing = 16, -32768
    scaled = torch.nan_to_num(steps * disparity, nan=missing).clamp(missing, -missing - 1).to(torch.int16)
    cv2.filterSpeckles(scaled.numpy(), missing, size, steps)
    return torch.where(scaled == missing, torch.nan, disparity)


def _refined_where(pair: GrayPair, disparity: Tensor, where: Tensor, options: RefineOptions) -> Tensor:
    """Disparity whose marked pixels are refined."""
    result = disparity.clone()
    for columns in stretches(where.any(0)):
        part = disparity[:, columns]
        refined = refine_disparity(pair.left[:, columns], pair.right, part, options, first_column=columns.start)
        result[:, columns] = torch.where(where[:, columns], refined.disparity, part)
    return result


def _within_range(disparity: Tensor, search: Search, width: int) -> Tensor:
    """Disparity of blocks without those outside of the range or with a partner outside of the image, ``width`` px."""
    column = BLOCK * torch.arange(disparity.shape[1]) + (BLOCK - 1) / 2

    def within(rows: Tensor) -> Tensor:
        # Both columns of a block: the lowest partner is 0, the highest width - 1.
        has_partner = (column - rows).sub_((width - 1) / 2).abs_() <= (width - BLOCK) / 2
        return torch.where(search.contains(rows) & has_partner, rows, torch.nan)

    return by_rows(within, disparity)
