"""How each row of a product lies against a profile: moved and rolled, robustly; all rows as one batch.

A profile H(x) that is moved by (Δx, Δh) and rolled by ρ about (x_m, h_m) departs, in height, by

    Δh - H' Δx + ρ ((x - x_m) + H' (H - h_m)),

and along its normal by the cosine of its slope times that. Weights are Tukey's.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD

_MOST_SAMPLES = 400  # of a row: neighbours err alike
_STEPS = 6
_CUT = 4.0  # standard deviations of a row
_LEAST_CUT_MM = 0.02
_LOOSE = (1e-2, 1e-2, 1e-1)  # roots of the information beforehand on (Δh, Δx, ρ), 1/mm and 1/rad, of one sample's noise
_LEAST_SHARE = 0.3  # of the profile's samples, below which a row is not placed


@dataclass(frozen=True)
class RowBasis:
    """Departures in height of a profile that moves up or sideways by 1 mm or rolls by 1 rad; NaN where unknown."""

    departures: Float[Tensor, "3 columns"]
    cosine: Float[Tensor, " columns"]

    @classmethod
    def of(
        cls, x: Float[Tensor, " columns"], height: Float[Tensor, " columns"], slope: Float[Tensor, " columns"]
    ) -> "RowBasis":
        """Of a profile about its middle."""
        middle, level = x[x.isfinite() & height.isfinite()].mean(), height.nanmean()
        turned = (x - middle) + slope * (height - level)
        return cls(torch.stack([torch.ones_like(slope), -slope, turned]), torch.rsqrt(1 + slope.square()))

    def placed(self, off: Float[Tensor, "rows columns"]) -> Float[Tensor, "rows 3"]:
        """(Δh, Δx, ρ) of rows whose heights are off by so much; NaN of rows that show next to nothing."""
        every = max(1, off.shape[1] // _MOST_SAMPLES)
        distance, by_place = (off * self.cosine)[:, ::every], (self.departures * self.cosine)[:, ::every]
        there = distance.isfinite() & by_place.isfinite().all(0)
        distance, by_place = distance.masked_fill(~there, 0.0), by_place.nan_to_num()
        loose = torch.diag(distance.new_tensor(_LOOSE).square())
        place = self._start(off)
        for step in range(_STEPS):
            left = distance - place @ by_place
            spread = NORMAL_OVER_MAD * left.abs().masked_fill(~there, torch.nan).nanmedian(1).values
            # From far away at first: the middle of a batch of rows is not that of one.
            cut = (_CUT * spread * (2.0 if step < 2 else 1.0)).clamp(min=_LEAST_CUT_MM)
            weight = (1 - (left / cut[:, None]).square()).clamp(min=0).square() * there
            normal = (by_place * weight[:, None]) @ by_place.T + loose
            place = place + torch.linalg.solve(normal, (weight * left) @ by_place.T)
        shown = there.sum(1) >= _LEAST_SHARE * by_place.any(0).sum()
        return place.masked_fill(~shown[:, None], torch.nan)

    def raised(self, place: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows columns"]:
        """By how much rows at these places are higher."""
        return place @ self.departures

    def _start(self, off: Tensor) -> Tensor:
        """The median rise of every row, which leaves all others off."""
        rise = off.nanmedian(1).values.nan_to_num()
        return torch.stack([rise, torch.zeros_like(rise), torch.zeros_like(rise)], 1)
