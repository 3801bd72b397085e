"""Normal equations of the columns' gains, the object's pattern eliminated segment by segment: a band of any length.

Of one segment, with weights w and means m of the logarithms at wanders s, F_s takes a row of the image to the pattern,
linearly between its columns. The pattern that fits gains λ best is K⁻¹ Σ_s F_s w (m - λ) with K = Σ_s F_s w, and
eliminates itself:

    [Σ_s w - Gᵀ K⁻¹ G] λ = Σ_s w m - Gᵀ K⁻¹ Σ_s F_s w m,     G = Σ_s F_s diag(w).

Columns further apart than the wander is wide have no entry in common.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

_ROUNDS, _SETTLED = 60, 1e-14  # of conjugate gradients; of the first residual, squared
_FEWEST = 4  # places that must have a column


@dataclass(frozen=True)
class GainEquations:
    """The normal equations of gains by column; sums of those of segments.

    Attributes:
        band: of the symmetric matrix, its entries (u, u + d) in row d.
        right: by column and colour. weight: of each column. places: how many wanders it was seen at.
    """

    band: Float[Tensor, "lags width"]
    right: Float[Tensor, "width channels"]
    weight: Float[Tensor, " width"]
    places: Float[Tensor, " width"]

    @classmethod
    def of_segment(
        cls,
        sums: Float[Tensor, "places width channels"],
        weight: Float[Tensor, "places width"],
        wander_px: Float[Tensor, " places"],
    ) -> "GainEquations":
        """Those of a segment.

        Args:
            sums: of the logarithms, at each wander. weight: how many they are of.
        """
        width = weight.shape[1]
        known = _by_lag(weight[..., None], wander_px)
        on_pattern = _sheared(known)
        count = on_pattern.sum(0).clamp(min=1e-9)
        pattern = _sheared(_by_lag(sums, wander_px)).sum(0) / count
        explained = torch.einsum("luo,lcu->uc", known, pattern.unfold(0, width, 1))
        root = (on_pattern / count.sqrt())[..., 0]
        band = -torch.stack([_correlated(root, lag, width) for lag in range(len(root))])
        band[0] += weight.sum(0)
        return cls(band, sums.sum(0) - explained, weight.sum(0), (weight > 0).sum(0).to(weight))

    def __add__(self, other: "GainEquations") -> "GainEquations":
        lags = max(len(self.band), len(other.band))
        one, two = (F.pad(each.band, (0, 0, 0, lags - len(each.band))) for each in (self, other))
        return GainEquations(
            one + two, self.right + other.right, self.weight + other.weight, self.places + other.places
        )

    def applied(self, gain: Float[Tensor, "width channels"]) -> Float[Tensor, "width channels"]:
        """The matrix times gains."""
        out = self.band[0, :, None] * gain
        for lag in range(1, min(len(self.band), len(gain))):
            entries = self.band[lag, :-lag, None]
            out[:-lag] += entries * gain[lag:]
            out[lag:] += entries * gain[:-lag]
        return out

    def solved(self) -> Float[Tensor, "width channels"]:
        """The gains' logarithms; NaN where a column was seen at too few places.

        Each colour by itself by conjugate gradients, as far as a few rounds go: what is observed settles first.
        """
        inverse = 1 / self.weight.clamp(min=1.0)[:, None]
        gain, left = torch.zeros_like(self.right), self.right
        step = inverse * left
        size = first = (left * step).sum(0)
        for _ in range(_ROUNDS):
            applied = self.applied(step)
            bend = (step * applied).sum(0)
            settled = (size <= _SETTLED * first) | (bend <= 0)
            if bool(settled.all()):
                break
            length = torch.where(settled, 0.0, size / bend.clamp(min=torch.finfo(bend.dtype).tiny))
            gain, left = gain + length * step, left - length * applied
            after = (left * inverse * left).sum(0)
            step, size = inverse * left + torch.where(settled, 0.0, after / size.clamp(min=1e-300)) * step, after
        return gain.masked_fill((self.places < _FEWEST)[:, None], torch.nan)


def _by_lag(
    values: Float[Tensor, "places width channels"], by: Float[Tensor, " places"]
) -> Float[Tensor, "lags width channels"]:
    """Values by how far, in whole columns, they lie from their part of the pattern, the furthest first."""
    first = by.floor()
    share = (by - first).to(values)[:, None, None]
    lag = (first.max() + 1 - first).long()
    out = values.new_zeros(int(lag.max()) + 1, *values.shape[1:])
    return out.index_add_(0, lag, (1 - share) * values).index_add_(0, lag - 1, share * values)


def _sheared(values: Float[Tensor, "lags width channels"]) -> Float[Tensor, "lags pattern channels"]:
    """Values where they lie on the pattern: those of row l moved by l columns."""
    lags, width, channels = values.shape
    padded = F.pad(values, (0, 0, 0, lags)).flatten(0, 1)
    return padded[: lags * (width + lags - 1)].view(lags, width + lags - 1, channels)


def _correlated(root: Float[Tensor, "lags pattern"], lag: int, width: int) -> Float[Tensor, " width"]:
    """Sums over the pattern of products of columns u and u + lag."""
    product = root[lag:] * root[: len(root) - lag]
    pattern = root.shape[1]
    return product.as_strided((len(product), width), (pattern + 1, 1), lag).sum(0)
