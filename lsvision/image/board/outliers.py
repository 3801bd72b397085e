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
_FEWEST_IN_LINE = 12
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

    Each is compared with the median of what pairs of neighbours say. At a corner of the board, or beside hidden ones,
    it can only be extrapolated, the way that works best on this board. What is too far follows from how far the same
    makes the board's other corners: under vibration or uneven travel all are out of line.
    """
    if int(valid.sum()) < _FEWEST_IN_LINE:
        return valid
    seen = valid.reshape(grid.shape[:2])
    node = torch.stack(torch.meshgrid(*(torch.arange(n).to(grid) for n in grid.shape[:2]), indexing="ij"), dim=-1)
    bent = grid - QuadraticMap.fitted(node[seen], grid[seen])(node)
    bent = torch.where(seen[..., None], bent, torch.nan)
    between, beyond = _said_by_neighbours(bent)
    is_between = between.isfinite().any(0)
    apart = torch.where(is_between, bent - torch.cat([between, beyond]).nanmedian(0).values, torch.nan)
    over = torch.where(is_between, _over_limit(apart[None]), _over_limit(bent - beyond))
    return valid & ~(over > 0).any(-1).flatten()


def _over_limit(apart: Float[Tensor, "ways rows columns 2"]) -> Float[Tensor, "rows columns 2"]:
    """By how much differences exceed what is usual on the board, the way that says most; NaN where none is known."""
    size = apart.abs()
    spread = _NORMAL * size.flatten(1, 2).nanmedian(1).values[:, None, None]
    limit = _OUT_OF_LINE_SPREADS * torch.where(spread.isfinite(), spread, torch.inf) + _OUT_OF_LINE_PX
    best = torch.where(size.isfinite(), limit, torch.inf).argmin(0, keepdim=True)
    return (size - limit).gather(0, best)[0]


def _said_by_neighbours(bent: Tensor) -> tuple[Tensor, Tensor]:
    """Where the neighbours along both axes put each place: means of two (2, rows, columns, 2), extrapolations (4, ..).

    NaN where such neighbours are missing.
    """
    padded = F.pad(bent, (0, 0, 2, 2, 2, 2), value=torch.nan)
    rows, columns = bent.shape[:2]

    def beside(down: int, right: int) -> Tensor:
        return padded[2 + down : 2 + down + rows, 2 + right : 2 + right + columns]

    between, beyond = [], []
    for down, right in ((0, 1), (1, 0)):
        before, after = beside(-down, -right), beside(down, right)
        between.append((before + after) / 2)
        beyond += [2 * before - beside(-2 * down, -2 * right), 2 * after - beside(2 * down, 2 * right)]
    return torch.stack(between), torch.stack(beyond)


def _median(values: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid, values, torch.nan).nanmedian()
