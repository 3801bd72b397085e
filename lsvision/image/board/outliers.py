"""Corners that are not to be trusted: under glare, shadow, smear or dirt, clipped, or behind something on the board."""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.lattice import QuadraticMap
from lsvision.image.board.saddle import SaddleFit

# How far the fit of a window may be from the board's median: a corner under glare, smear or dirt is another picture.
_WORST_BLUR, _LEAST_CONTRAST = 2.0, 0.3
# Residuals of sound windows are within 1.2 of their median, those of photographs with windows of few pixels within 1.6.
_LEAST_RESIDUAL_EXCESS, _EXCESS_SPREADS = 0.35, 6.0
_CLIPPED_LEVEL = 0.998  # of the largest number that the pixels can have
_CLIPPED_APART = 0.15  # share of a window's pixels, from the board's median: white squares with a bright rim are sound
_OUT_OF_LINE_SPREADS, _OUT_OF_LINE_PX = 12.0, 0.5  # perspective and lenses bend rows at the rim
_TELLS, _AGREES = 2.0, 0.5  # neighbours along one axis: their spread over that of all; share of the limit to agree
_FEWEST_IN_LINE = 12
_ALONG_X, _ALONG_Y = (0, 1), (1, 0)  # steps (down, right) of a grid
_NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


def like_the_board(fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> Bool[Tensor, " corners"]:
    """Valid corners whose windows look like those of the rest of the board.

    Noise of a sensor does not grow with the light and that of a surface does: a residual is too large where it is so
    in grey values and in shares of the contrast.
    """
    valid = valid & (fit.blur_px < _WORST_BLUR * _median(fit.blur_px, valid))
    valid = valid & (fit.contrast > _LEAST_CONTRAST * _median(fit.contrast, valid))
    relative = fit.residual / fit.contrast
    excess = torch.minimum(fit.residual / _median(fit.residual, valid), relative / _median(relative, valid)) - 1
    spread = _NORMAL * _median(excess.abs(), valid)
    return valid & (excess <= (_EXCESS_SPREADS * spread).clamp(min=_LEAST_RESIDUAL_EXCESS))


def evenly_clipped(
    windows: Float[Tensor, "corners size size"],
    mask: Bool[Tensor, "corners size size"],
    valid: Bool[Tensor, " corners"],
) -> Bool[Tensor, " corners"]:
    """Valid corners whose windows have no more pixels at the end of the sensor's range than the board's median.

    Where white squares are clipped evenly the corners stay where they are; at the rim of glare they move.
    """
    brightest = float(windows[valid].max()) if bool(valid.any()) else 0.0
    end = 2 ** max(8, int(brightest).bit_length()) - 1
    share = (mask & (windows >= _CLIPPED_LEVEL * end)).sum((1, 2)) / mask.sum((1, 2))
    return valid & ((share <= _CLIPPED_APART) | ((share - _median(share, valid)).abs() <= _CLIPPED_APART))


def in_line_with_neighbours(
    grid: Float[Tensor, "rows columns 2"], valid: Bool[Tensor, " corners"]
) -> Bool[Tensor, " corners"]:
    """Valid corners that lie where their neighbours on the board expect them.

    Each is compared with the median of what pairs of neighbours say, on both of its sides or on one. What is too far
    follows from the board itself: under vibration all corners are out of line. It moves whole lines of the scan, and
    with them whole rows of a board: a corner stays where neighbours along one axis, which tell as much as all, expect
    it, and one that is between neighbours along one axis only may be out of line by as much as those beside it.
    """
    if int(valid.sum()) < _FEWEST_IN_LINE:
        return valid
    seen = valid.reshape(grid.shape[:2])
    node = torch.stack(torch.meshgrid(*(torch.arange(n).to(grid) for n in grid.shape[:2]), indexing="ij"), dim=-1)
    bent = grid - QuadraticMap.fitted(node[seen], grid[seen])(node)
    apart = _apart(torch.where(seen[..., None], bent, torch.nan))
    known, spread, limit = apart.isfinite(), _spread(apart), _limit(apart)
    far_beside = _too_far(torch.stack([apart[1] - _beside(apart[1], _ALONG_Y), apart[2] - _beside(apart[2], _ALONG_X)]))
    wrong = _too_far(apart)[0]
    for axis, other in ((1, 2), (2, 1)):
        agrees = (apart[axis].abs() <= _AGREES * limit[axis]) & (spread[axis] < _TELLS * spread[0])
        wrong = wrong & ~agrees
        wrong = torch.where(known[axis] & ~known[other], far_beside[axis - 1], wrong)
    return valid & ~wrong.any(-1).flatten()


def _apart(bent: Float[Tensor, "rows columns 2"]) -> Float[Tensor, "3 rows columns 2"]:
    """How far each place is from the median of what all its neighbours, those along X and those along Y say.

    NaN where it is between none of them: a corner of the board itself could only be extrapolated, and uneven travel
    would look like an error.
    """
    said, by_axis = [], []
    for axis in (_ALONG_X, _ALONG_Y):
        before_2, before, after, after_2 = (_shifted(bent, axis, step) for step in (-2, -1, 1, 2))
        said.append(torch.stack([(before + after) / 2, 2 * before - before_2, 2 * after - after_2]))
        complete = said[-1].isfinite().all(0)
        by_axis.append(torch.where(complete, said[-1].median(0).values, said[-1][0]))
    between = by_axis[0].isfinite() | by_axis[1].isfinite()
    by_all = torch.where(between, torch.cat(said).nanmedian(0).values, torch.nan)
    return bent - torch.stack([by_all, *by_axis])


def _beside(values: Float[Tensor, "rows columns 2"], axis: tuple[int, int]) -> Float[Tensor, "rows columns 2"]:
    """Median of the values up to two places off along an axis."""
    return torch.stack([_shifted(values, axis, step) for step in (-2, -1, 1, 2)]).nanmedian(0).values


def _shifted(values: Float[Tensor, "rows columns 2"], axis: tuple[int, int], step: int) -> Tensor:
    """The values some places, at most two, further along an axis; NaN beyond the rim."""
    padded = F.pad(values, (0, 0, 2, 2, 2, 2), value=torch.nan)
    down, right = 2 + step * axis[0], 2 + step * axis[1]
    return padded[down : down + values.shape[0], right : right + values.shape[1]]


def _spread(apart: Float[Tensor, "tests rows columns 2"]) -> Float[Tensor, "tests 1 1 2"]:
    spread = _NORMAL * apart.abs().flatten(1, 2).nanmedian(1).values
    return spread.nan_to_num(torch.inf)[:, None, None]


def _too_far(apart: Float[Tensor, "tests rows columns 2"]) -> Bool[Tensor, "tests rows columns 2"]:
    return apart.abs() > _limit(apart)


def _limit(apart: Float[Tensor, "tests rows columns 2"]) -> Float[Tensor, "tests 1 1 2"]:
    return _OUT_OF_LINE_SPREADS * _spread(apart) + _OUT_OF_LINE_PX


def _median(values: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid, values, torch.nan).nanmedian()
