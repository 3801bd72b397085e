"""Residuals of a match that are more than noise: of another surface, a highlight, or other light than elsewhere."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

_TILE, _STEP = 64, 8  # px; the noise is estimated from every eighth pixel in both directions
_ENOUGH = 0.5  # share of a tile that must be matched before its noise is estimated
_DISTURBED = 24.0  # times the usual variance


@dataclass(frozen=True)
class Misfit:
    """How far residuals exceed noise.

    Attributes:
        noise_variance: the usual variance of the residuals, of the map or of the surroundings, whichever is larger.
        factor: by which the variance of a disparity grows, 1 at least: residuals this large are no independent noise.
    """

    noise_variance: Float[Tensor, "rows columns"]
    factor: Float[Tensor, "rows columns"]

    @classmethod
    def of(cls, variance: Float[Tensor, "rows columns"], block: int) -> "Misfit":
        """That of the residuals around each block of ``block`` pixels a side, NaN where there is no match."""
        sampled = variance[:: _STEP // block, :: _STEP // block]
        usual = sampled.nanmedian()
        around = torch.fmax(_tile_medians(sampled), usual)
        side = _TILE // block
        around = around.repeat_interleave(side, 0)[: len(variance)].repeat_interleave(side, 1)[:, : variance.shape[1]]
        return cls(around, variance.div(_DISTURBED * usual).clamp_(min=1.0))


def usual_variance(variance: Float[Tensor, "rows columns"], block: int) -> float:
    """The median over a map of the variance around each block of ``block`` pixels a side; NaN where there is none."""
    return float(variance[:: _STEP // block, :: _STEP // block].nanmedian())


def _tile_medians(sampled: Float[Tensor, "rows columns"]) -> Float[Tensor, "tile_rows tile_columns"]:
    """Median over each tile, NaN where less than half of it has a match."""
    side = _TILE // _STEP
    padded = F.pad(sampled, (0, -sampled.shape[1] % side, 0, -sampled.shape[0] % side), value=torch.nan)
    rows, columns = (size // side for size in padded.shape)
    tiles = padded.view(rows, side, columns, side).transpose(1, 2).reshape(rows, columns, side * side)
    enough = tiles.isnan().float().mean(-1) <= 1.0 - _ENOUGH
    return torch.where(enough, tiles.nanmedian(-1).values, torch.nan)
