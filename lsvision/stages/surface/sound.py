"""How much sound surface scatters, and how bright it is, by place around the object.

Windows all over the product, at places that depend on its size alone, are smoothed as candidates are looked for; what
most of a window shows is sound. So errors of the matching that neighbours share count as they come.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.profile import SurfaceProfile
from lsvision.stages.surface.smoothed import Paraboloid, Smoothing
from lsvision.stages.surface.strips import SurfaceStrip, Unrolling, strip_of
from lsvision.types import ProductSource

_WINDOWS, _ROWS, _APART = 24, 3, 4  # windows; rows of each that count, cells of the Gaussian's sigma apart
_AROUND_MM = 1.0  # to either side of a place, over which its scatter is taken
_END_MM = 2.5  # from an end of the profile
_MOST, _MOST_IN_SIGMAS = 0.95, 1.96  # of the values of a normal distribution, and where these end
_LEAST_SIGMA_MM, _LEAST_CONTRAST = 1e-4, 1e-3


@dataclass(frozen=True)
class SoundSurface:
    """Of sound surface, by place around the object.

    Attributes:
        smooth_mm, cell_mm: standard deviations of departures, smoothed and of single cells. fitted_mm: of each of the
            fitted paraboloids, anywhere.
        brightness: the median. contrast: standard deviation of the smoothed relative brightness.
        cells_alike: how many cells err together.
    """

    smooth_mm: Float[Tensor, " cells"]
    fitted_mm: Float[Tensor, " fits"]
    cell_mm: Float[Tensor, " cells"]
    brightness: Float[Tensor, " cells"]
    contrast: Float[Tensor, " cells"]
    cells_alike: float

    def relative(self, brightness: Float[Tensor, "rows cells"]) -> Float[Tensor, "rows cells"]:
        """Brightness over that of the surroundings, less one; rows differ by a factor."""
        ratio = brightness / self.brightness.to(brightness)
        level = ratio.nanmedian(1, keepdim=True).values
        return ratio / level.masked_fill(level <= 0, torch.nan) - 1


def sound_surface(
    source: ProductSource, profile: SurfaceProfile, unrolling: Unrolling, smoothing: Smoothing, config: SurfaceConfig
) -> SoundSurface:
    """Look at windows all over a product."""
    strips = [strip_of(source, profile, unrolling, rows, config) for rows in _windows(source.grid.rows, smoothing)]
    brightness = torch.cat([strip.brightness.masked_fill(~strip.departure.isfinite(), torch.nan) for strip in strips])
    usual = brightness.nanmedian(0).values
    usual = usual.nan_to_num(float(usual.nanmedian().nan_to_num(1.0))).clamp(min=1e-3)
    one = torch.ones_like(usual)
    level = SoundSurface(one, one[:1], one, usual, one, 1.0)
    planes = torch.cat([_planes(strip, level, smoothing) for strip in strips], dim=1)
    reach = round(_AROUND_MM / unrolling.pitch_mm)
    near_end = near_ends(profile, unrolling, _END_MM)
    smooth, cell, box, contrast = (_scatter(plane, reach, near_end) for plane in planes)
    alike = smoothing.size**2 * float((box / cell).nanmedian()) ** 2
    smooth, cell = (of.clamp(min=_LEAST_SIGMA_MM) for of in (smooth, cell))
    fits = [_fitted(strips, fit, smoothing) for fit in smoothing.fits]
    return SoundSurface(smooth, torch.tensor(fits), cell, usual, contrast.clamp(min=_LEAST_CONTRAST), max(alike, 1.0))


def _windows(rows: int, smoothing: Smoothing) -> list[range]:
    """Rows of every window; they overlap in a short product."""
    long = min(rows, 2 * smoothing.halo + (_ROWS - 1) * _apart(smoothing) + 1)
    starts = sorted({index * (rows - long) // (_WINDOWS - 1) for index in range(_WINDOWS)})
    return [range(start, start + long) for start in starts]


def _apart(smoothing: Smoothing) -> int:
    return max(1, round(_APART * smoothing.sigma))


def _planes(strip: SurfaceStrip, level: SoundSurface, smoothing: Smoothing) -> Float[Tensor, "planes rows cells"]:
    """Rows of a window that count: departures smoothed, as they are and averaged; smoothed contrast."""
    departure = strip.departure
    planes = [
        smoothing.smooth(departure),
        departure,
        smoothing.averaged(departure),
        smoothing.smooth(level.relative(strip.brightness)),
    ]
    inner = slice(min(smoothing.halo, (len(departure) - 1) // 2), None, _apart(smoothing))
    return torch.stack(planes)[:, inner][:, :_ROWS]


def _fitted(strips: Sequence[SurfaceStrip], fit: Paraboloid, smoothing: Smoothing) -> float:
    """Robust standard deviation of paraboloids at places spread over the windows."""
    values = []
    for strip in strips:
        rows, cells = strip.departure.shape
        cell = torch.arange(fit.reach, cells - fit.reach, max(1, fit.reach))
        row = torch.full_like(cell, min(smoothing.halo, rows // 2))
        values.append(fit.extreme(strip.departure, row, cell))
    off = torch.cat(values)
    return max(_LEAST_SIGMA_MM, float(NORMAL_OVER_MAD * (off - off.nanmedian()).abs().nanmedian().nan_to_num(1.0)))


def near_ends(profile: SurfaceProfile, unrolling: Unrolling, within_mm: float) -> Bool[Tensor, " cells"]:
    """Cells near the ends of the profile, and near its gaps: windows of the matching see two heights there."""
    gap = ~(profile.measured[unrolling.before] & profile.measured[unrolling.before + 1])
    reach = round(within_mm / unrolling.pitch_mm)
    return pad(gap, (reach, reach), value=True).unfold(0, 2 * reach + 1, 1).any(-1)


def _scatter(
    values: Float[Tensor, "rows cells"], reach: int, near_end: Bool[Tensor, " cells"]
) -> Float[Tensor, " cells"]:
    """Robust standard deviation of columns with those about them; of all where a place shows next to nothing.

    It is what half of the values lie within; near ends what all but a twentieth do, where that is more: a few are far
    off there. Elsewhere these would be marks.
    """
    off = (values - values.nanmedian(0).values).abs()
    around = pad(off, (reach, reach), value=torch.nan).unfold(1, 2 * reach + 1, 1).movedim(-1, 1).flatten(0, 1)
    half = around.nanmedian(0).values * NORMAL_OVER_MAD
    most = around[:, near_end].nanquantile(_MOST, dim=0) / _MOST_IN_SIGMAS
    half[near_end] = torch.maximum(half[near_end], most)
    return half.nan_to_num(float(half.nanmedian().nan_to_num(1.0)))
