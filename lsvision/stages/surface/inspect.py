"""Product -> the unrolled surface, strip by strip, and the candidates on it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from lsvision.stages.surface.candidates import Measuring, without_relief
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.marks import MarkedSurface, grouped
from lsvision.stages.surface.profile import SurfaceProfile, profile_of
from lsvision.stages.surface.regions import Regions, Strip
from lsvision.stages.surface.smoothed import Paraboloid, Smoothing
from lsvision.stages.surface.sound import SoundSurface, near_ends, sound_surface
from lsvision.stages.surface.strips import (
    STRIP_ROWS,
    SurfaceStrip,
    Surroundings,
    Unrolling,
    strip_of,
    with_neighbours,
)
from lsvision.types import ProductSource

_LEAST_MARGIN = 12  # cells: windows of the matching are so wide on the coarsest cameras, too


@dataclass(frozen=True)
class SurfacePlan:
    """What has to be known of a whole product before its strips are unrolled."""

    profile: SurfaceProfile
    unrolling: Unrolling
    smoothing: Smoothing
    sound: SoundSurface
    looked_at: Bool[Tensor, " cells"]

    @classmethod
    def of(cls, source: ProductSource, config: SurfaceConfig) -> "SurfacePlan":
        """Of a product.

        Raises:
            NoProfileError: it shows no profile.
        """
        pitch = source.grid.pitch_mm
        profile = profile_of(source, config)
        unrolling, smoothing = (
            Unrolling.of(profile, pitch),
            Smoothing.of(config.smoothing_mm, pitch, config.matching_blur),
        )
        sound = sound_surface(source, profile, unrolling, smoothing, config)
        margin = max(config.margin_mm, _LEAST_MARGIN * pitch)
        return cls(profile, unrolling, smoothing, sound, ~near_ends(profile, unrolling, margin))


def find_candidates(
    source: ProductSource,
    plan: SurfacePlan,
    config: SurfaceConfig,
    written: Callable[[SurfaceStrip], None] = lambda strip: None,
) -> MarkedSurface:
    """Unroll a product from end to end and look for candidates, those that stand out most first.

    Args:
        written: takes every strip of the unrolled surface, in order.
    """
    dents, bumps, darker, brighter = (Regions() for _ in range(4))
    for around in with_neighbours(_strips(source, plan, config, written), plan.smoothing.halo):
        seen = _Seen.of(around, plan, config)
        for relief, colors, sign in ((dents, darker, -1.0), (bumps, brighter, 1.0)):
            relief.add(seen.relief(sign))
            colors.add(seen.colored(sign))
    measuring = Measuring(source.grid, plan.unrolling, plan.sound, plan.smoothing.fits, config)
    raised = [*measuring.candidates("dent", dents.table()), *measuring.candidates("bump", bumps.table())]
    colored = [*measuring.candidates("color", darker.table()), *measuring.candidates("color", brighter.table())]
    by_color = without_relief(colored, raised, source.grid.pitch_mm)
    ranked = sorted([*raised, *by_color], key=lambda candidate: (-candidate.ratio, candidate.along_mm))
    return grouped(ranked[: config.most_candidates], config)


def _strips(
    source: ProductSource, plan: SurfacePlan, config: SurfaceConfig, written: Callable[[SurfaceStrip], None]
) -> Iterator[SurfaceStrip]:
    for start in range(0, source.grid.rows, STRIP_ROWS):
        rows = range(start, min(start + STRIP_ROWS, source.grid.rows))
        strip = strip_of(source, plan.profile, plan.unrolling, rows, config)
        if strip.sigma is None:
            by_place = plan.sound.cell_mm.float().expand_as(strip.deviation)
            strip = replace(strip, sigma=by_place.masked_fill(~strip.deviation.isfinite(), torch.nan))
        written(strip)
        yield strip


@dataclass(frozen=True)
class _Seen:
    """A strip as candidates are looked for in it: departures smoothed and fitted, and relative brightness."""

    row: int
    halo: int
    departure: Tensor
    smooth: Tensor
    contrast: Tensor
    fits: tuple[Paraboloid, ...]
    looked_at: Tensor
    low: float
    color_low: float
    unit: Tensor
    color_unit: Tensor

    @classmethod
    def of(cls, around: Surroundings, plan: SurfacePlan, config: SurfaceConfig) -> "_Seen":
        """Of rows with those about them."""
        inner, smoothing, sound = around.inner, plan.smoothing, plan.sound
        return cls(
            around.row,
            around.halo,
            around.departure,
            smoothing.smooth(around.departure)[inner],
            smoothing.smooth(sound.relative(around.brightness))[inner],
            smoothing.fits,
            plan.looked_at,
            config.low_sigma,
            config.color_low_sigma,
            sound.smooth_mm.clamp(min=config.least_depth_mm / config.high_sigma).float(),
            sound.contrast.clamp(min=config.least_contrast / config.color_high_sigma).float(),
        )

    def relief(self, sign: float) -> Strip:
        """Where the surface lies inwards (-1) or outwards (1) of its surroundings."""
        ratio = sign * self.smooth / self.unit
        return Strip(self.row, (ratio > self.low) & self.looked_at, ratio, self.smooth, self.contrast, self._fitted)

    def colored(self, sign: float) -> Strip:
        """Where it is darker (-1) or brighter (1) than these."""
        ratio = sign * self.contrast / self.color_unit
        return Strip(
            self.row, (ratio > self.color_low) & self.looked_at, ratio, self.contrast, self.contrast, self._not_fitted
        )

    def _fitted(self, row: Tensor, cell: Tensor) -> Tensor:
        return torch.stack([fit.extreme(self.departure, row + self.halo, cell) for fit in self.fits])

    def _not_fitted(self, row: Tensor, cell: Tensor) -> Tensor:
        """Of colours."""
        return torch.full((len(self.fits), len(row)), torch.nan, dtype=torch.float64)
