"""Corners that are not to be trusted: under glare, shadow, smear or dirt, clipped, or behind something on the board."""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.image.board.lattice import QuadraticMap
from lsvision.image.board.saddle import SaddleFit

# How far the fit of a window may be from the board's median: a corner under glare, smear or dirt is another picture.
_WORST_BLUR, _LEAST_CONTRAST = 2.0, 0.3
# Residuals of sound windows are within 1.2 of their median, those of photographs with windows of few pixels within 1.6.
_LEAST_RESIDUAL_EXCESS, _EXCESS_SPREADS = 0.35, 6.0
_CLIPPED_LEVEL = 0.998  # of the largest number that the pixels can have
_CLIPPED_APART = 0.15  # share of a window's pixels, from the board's median: white squares with a bright rim are sound
_OUT_OF_LINE_SPREADS, _OUT_OF_LINE_PX = 12.0, 0.5  # perspective and lenses bend rows at the rim
_ONE_AXIS, _AGREES = 2.0, 0.5  # neighbours along one axis: their spread over that of all; share of the limit to agree
_FEWEST_IN_LINE = 12
_ALONG_X, _ALONG_Y = (0, 1), (1, 0)  # steps (down, right) of a grid


def like_the_board(fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> Bool[Tensor, " corners"]:
    """Valid corners whose windows look like those of the rest of the board.

    Noise of a sensor does not grow with the light and that of a surface does: a residual is too large where it is so
    in grey values and in shares of the contrast.
    """
    valid = valid & (fit.blur_px < _WORST_BLUR * _median(fit.blur_px, valid))
    valid = valid & (fit.contrast > _LEAST_CONTRAST * _median(fit.contrast, valid))
    relative = fit.residual / fit.contrast
    excess = torch.minimum(fit.residual / _median(fit.residual, valid), relative / _median(relative, valid)) - 1
    spread = NORMAL_OVER_MAD * _median(excess.abs(), valid)
    return valid & (excess <= (_EXCESS_SPREADS * spread).clamp(min=_LEAST_RESIDUAL_EXCESS))


def evenly_clipped(
    brightest: Float[Tensor, "corners size size"],
    mask: Bool[Tensor, "corners size size"],
    valid: Bool[Tensor, " corners"],
) -> Bool[Tensor, " corners"]:
    """Valid corners whose windows have no more pixels at the end of the sensor's range than the board's median.

    Where white squares are clipped evenly the corners stay where they are; at the rim of glare they move.

    Args:
        brightest: the largest of each pixel's colours, of which any may be clipped alone.
    """
    most = float(brightest[valid].max()) if bool(valid.any()) else 0.0
    end = 2 ** max(8, int(most).bit_length()) - 1
    share = (mask & (brightest >= _CLIPPED_LEVEL * end)).sum((1, 2)) / mask.sum((1, 2))
    return valid & ((share <= _CLIPPED_APART) | ((share - _median(share, valid)).abs() <= _CLIPPED_APART))


def in_line_with_neighbours(
    grid: Float[Tensor, "rows columns 2"], valid: Bool[Tensor, " corners"]
) -> Bool[Tensor, " corners"]:
    """Valid corners that lie where their neighbours on the board expect them.

    Each is compared with the median of what pairs of neighbours say: those on both of its sides where it has such, as
    at a corner of the board, or beside hidden ones, it can only be extrapolated. What is too far follows from how far
    the same makes the board's other corners: under vibration or uneven travel all are out of line. A vibration moves
    whole lines of the scan, and with them whole rows of a board: a corner is kept where neighbours along one axis
    expect it, if these fit as well as all neighbours do, and one between neighbours along one axis only may be as far
    off as those beside it.
    """
    if int(valid.sum()) < _FEWEST_IN_LINE:
        return valid
    seen = valid.reshape(grid.shape[:2])
    node = torch.stack(torch.meshgrid(*(torch.arange(n).to(grid) for n in grid.shape[:2]), indexing="ij"), dim=-1)
    bent = grid - QuadraticMap.fitted(node[seen], grid[seen])(node)
    bent = torch.where(seen[..., None], bent, torch.nan)
    between, beyond = (bent - said for said in _said_by_neighbours(bent))
    _, by_x, by_y = between
    by_beside = _is_far(torch.stack([by_x - _beside(by_x, _ALONG_Y), by_y - _beside(by_y, _ALONG_X)]))
    only_x, only_y = by_y.isnan() & by_x.isfinite(), by_x.isnan() & by_y.isfinite()
    far = torch.where(between[0].isfinite(), _is_out_of_line(between), _is_out_of_line(beyond))
    by_beside = by_beside & _is_far(between)[0]
    far = torch.where(only_x, by_beside[0], torch.where(only_y, by_beside[1], far))
    return valid & ~far.any(-1).flatten()


def _said_by_neighbours(bent: Float[Tensor, "rows columns 2"]) -> tuple[Tensor, Tensor]:
    """Where neighbours put each place: those on both of its sides, ``(3, rows, columns, 2)``, those on one of them.

    Medians of what all, those along X and those along Y say; NaN where such neighbours are missing.
    """
    said, between, beyond = [], [], []
    for axis in (_ALONG_X, _ALONG_Y):
        before_2, before, after, after_2 = (_shifted(bent, axis, step) for step in (-2, -1, 1, 2))
        said.append(torch.stack([(before + after) / 2, 2 * before - before_2, 2 * after - after_2]))
        complete = said[-1].isfinite().all(0)
        between.append(torch.where(complete, said[-1].median(0).values, said[-1][0]))
        beyond.append(said[-1][1:].nanmedian(0).values)
    is_between = between[0].isfinite() | between[1].isfinite()
    by_all = torch.where(is_between, torch.cat(said).nanmedian(0).values, torch.nan)
    from_beyond = torch.cat([said[0][1:], said[1][1:]]).nanmedian(0).values
    return torch.stack([by_all, *between]), torch.stack([from_beyond, *beyond])


def _is_out_of_line(apart: Float[Tensor, "3 rows columns 2"]) -> Bool[Tensor, "rows columns 2"]:
    """What is far from where all neighbours expect it, and not about where those along one axis do."""
    spread, limit, wrong = _spread(apart), _limit(apart), _is_far(apart)[0]
    for axis in (1, 2):
        agrees = (apart[axis].abs() <= _AGREES * limit[axis]) & (spread[axis] < _ONE_AXIS * spread[0])
        wrong = wrong & ~agrees
    return wrong


def _beside(values: Float[Tensor, "rows columns 2"], axis: tuple[int, int]) -> Float[Tensor, "rows columns 2"]:
    """Median of the values up to two places off along an axis."""
    return torch.stack([_shifted(values, axis, step) for step in (-2, -1, 1, 2)]).nanmedian(0).values


def _shifted(values: Float[Tensor, "rows columns 2"], axis: tuple[int, int], step: int) -> Tensor:
    """The values some places, at most two, further along an axis; NaN beyond the rim."""
    padded = F.pad(values, (0, 0, 2, 2, 2, 2), value=torch.nan)
    down, right = 2 + step * axis[0], 2 + step * axis[1]
    return padded[down : down + values.shape[0], right : right + values.shape[1]]


def _spread(apart: Float[Tensor, "tests rows columns 2"]) -> Float[Tensor, "tests 1 1 2"]:
    spread = NORMAL_OVER_MAD * apart.abs().flatten(1, 2).nanmedian(1).values
    return spread.nan_to_num(torch.inf)[:, None, None]


def _limit(apart: Float[Tensor, "tests rows columns 2"]) -> Float[Tensor, "tests 1 1 2"]:
    return _OUT_OF_LINE_SPREADS * _spread(apart) + _OUT_OF_LINE_PX


def _is_far(apart: Float[Tensor, "tests rows columns 2"]) -> Bool[Tensor, "tests rows columns 2"]:
    return apart.abs() > _limit(apart)


def _median(values: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid, values, torch.nan).nanmedian()
