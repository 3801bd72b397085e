"""How many lines the right image of a pair is out of step with the left one.

Where the cameras' triggers differ, or one is mounted a little ahead, line v of the left image and line v + offset of
the right one see the object at the same place. In tiles of a matched band, the change of the left image from line to
line explains what is left of the difference between the two images:

    left - right = q s_u + r s_v + g m + o

with the slopes s_u, s_v of the left image along and across its lines, an error q of the disparity, a factor g and an
offset o of brightness, m the mean of both images, and r the row offset.

Source: Lucas & Kanade 1981, in two dimensions, with brightness as unknown as in Gruen 1985.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

TILE = 8  # px along the side of a tile
_LEAST_TILES = 12
_LEAST_EXPLAINED = 0.5  # of a tile's grey values, by a match that is right
_OUTLIER = 3.0  # robust standard deviations
_RIDGE = 1.0  # variance of grey values that is added to each unknown's


@dataclass(frozen=True)
class RowOffset:
    """Line v of the left image belongs to line v + ``lines`` of the right one; NaN where nothing was measured.

    Args:
        lines: a fraction where the cameras are out of step by one.
        sigma: its standard deviation.
    """

    lines: float
    sigma: float

    @property
    def whole(self) -> int:
        """Whole lines by which the right image is shifted before it is matched; 0 where the offset is not known."""
        return round(self.lines) if math.isfinite(self.lines) else 0


@dataclass(frozen=True)
class Tiles:
    """What each tile of a band says: its row offset, px, the weight of that, and the share that its match explains."""

    offset: Float[Tensor, " tiles"]
    weight: Float[Tensor, " tiles"]
    explained: Float[Tensor, " tiles"]

    @classmethod
    def of(
        cls,
        left: Float[Tensor, "lines width"],
        warped: Float[Tensor, "lines width"],
        valid: Bool[Tensor, "lines width"],
    ) -> "Tiles":
        """Those of a band: the left image, the right one warped to it, and where it has a disparity.

        Tiles that are not valid throughout explain nothing.
        """
        across = (left[2:, 1:-1] - left[:-2, 1:-1]) / 2
        along = (left[1:-1, 2:] - left[1:-1, :-2]) / 2
        middle = (slice(1, -1), slice(1, -1))
        difference, mean = (left - warped)[middle], ((left + warped) / 2)[middle]
        tiles = [_tiled(values) for values in (across, along, mean, difference, left[middle])]
        across, along, mean, difference, own = (values - values.mean(1, keepdim=True) for values in tiles)
        seen = _tiled(valid[middle].to(left.dtype)).mean(1) == 1.0
        nuisance = torch.stack([along, mean], 2)
        rest = difference - _projection(nuisance, difference)
        slope = across - _projection(nuisance, across)
        information = slope.square().sum(1)
        offset = (slope * rest).sum(1) / information.clamp(min=_RIDGE)
        residual = (rest - offset[:, None] * slope).square().mean(1)
        explained = torch.where(seen, 1 - residual / own.square().mean(1).clamp(min=_RIDGE), 0.0).clamp(min=0)
        weight = torch.where(explained > _LEAST_EXPLAINED, information / residual.clamp(min=_RIDGE), 0.0)
        return cls(offset, weight, explained)

    @property
    def score(self) -> float:
        """How well the band matches, 0..1: the mean share that its tiles explain."""
        return float(self.explained.mean()) if len(self.explained) else 0.0


def joined(tiles: list[Tiles]) -> Tiles:
    """The tiles of several bands."""
    return Tiles(*(torch.cat([getattr(part, name) for part in tiles]) for name in ("offset", "weight", "explained")))


def row_offset(tiles: Tiles) -> RowOffset:
    """The row offset, px, that most tiles agree on: a weighted mean without outliers."""
    used = tiles.weight > 0
    if int(used.sum()) < _LEAST_TILES:
        return RowOffset(math.nan, math.nan)
    offset, weight = tiles.offset[used].double(), tiles.weight[used].double()
    middle = offset.median()
    spread = (offset - middle).abs().median() / 0.6745
    weight = weight * ((offset - middle).abs() <= _OUTLIER * spread + 1e-9)
    mean = (weight * offset).sum() / weight.sum()
    # From the scatter of the tiles: their errors are more than noise.
    variance = (weight * (offset - mean)).square().sum() / weight.sum().square()
    return RowOffset(float(mean), float(variance.sqrt()))


def _tiled(values: Tensor) -> Tensor:
    """Values of each whole tile, ``(tiles, TILE²)``."""
    rows, columns = (size // TILE for size in values.shape)
    return values[: rows * TILE, : columns * TILE].view(rows, TILE, columns, TILE).transpose(1, 2).reshape(-1, TILE**2)


def _projection(basis: Tensor, values: Tensor) -> Tensor:
    """The part of each tile's values that its basis ``(tiles, pixels, unknowns)`` explains."""
    ridge = _RIDGE * torch.eye(basis.shape[2], dtype=basis.dtype)
    normal = basis.mT @ basis + ridge
    return (basis @ torch.linalg.solve(normal, basis.mT @ values[..., None]))[..., 0]
