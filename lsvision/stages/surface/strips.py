"""Rows of a product -> the unrolled surface: colour and distance from the profile by arc length around the object."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.profile import SurfaceProfile
from lsvision.types import ProductGrid, ProductSource

STRIP_ROWS = 512  # taken at once, at places that depend on nothing else


@dataclass(frozen=True)
class Unrolling:
    """How columns of a product map to cells of the unrolled surface, as wide as the product's.

    Cell i lies ``origin_mm + i pitch_mm`` around the object from its crown, between columns ``before`` and the next.
    """

    origin_mm: float
    pitch_mm: float
    before: Shaped[Tensor, " cells"]
    share: Float[Tensor, " cells"]
    q_x: Float[Tensor, " cells"]
    slope: Float[Tensor, " cells"]

    @classmethod
    def of(cls, profile: SurfaceProfile, pitch_mm: float) -> "Unrolling":
        """Of a profile."""
        first, last = (int(edge) for edge in (profile.around[[0, -1]] / pitch_mm).trunc())
        around = pitch_mm * torch.arange(first, last + 1).double()
        after = torch.searchsorted(profile.around, around).clamp(1, len(profile.around) - 1)
        low, high = profile.around[after - 1], profile.around[after]
        share = ((around - low) / (high - low)).clamp(0.0, 1.0)
        q_x, slope = (torch.lerp(of[after - 1], of[after], share) for of in (profile.q_x, profile.slope))
        return cls(first * pitch_mm, pitch_mm, after - 1, share, q_x, slope)

    @property
    def cells(self) -> int:
        """Around the object."""
        return len(self.before)

    @property
    def around(self) -> Float[Tensor, " cells"]:
        """Arc length of every cell, mm."""
        return self.origin_mm + self.pitch_mm * torch.arange(self.cells).double()

    def grid(self, product: ProductGrid) -> ProductGrid:
        """Of the unrolled images of a product: their columns are arc lengths."""
        return ProductGrid(product.rows, self.cells, self.pitch_mm, product.origin_y_mm, self.origin_mm)

    def taken(self, values: Float[Tensor, "rows columns"]) -> Float[Tensor, "rows cells"]:
        """Values by arc length, float32; NaN where either neighbour is."""
        values = values.float()
        return torch.lerp(values[:, self.before], values[:, self.before + 1], self.share.float())

    def taken_color(self, color: Shaped[Tensor, "rows columns channels"]) -> Shaped[Tensor, "rows cells channels"]:
        """Colours by arc length, rounded to their dtype."""
        first, second = color[:, self.before].float(), color[:, self.before + 1].float()
        return torch.lerp(first, second, self.share.float()[:, None]).round().to(color.dtype)


@dataclass(frozen=True)
class SurfaceStrip:
    """Rows of the unrolled surface.

    Attributes:
        row: the first.
        deviation: distance from the product's profile along its normal, mm, above zero outwards; NaN for none.
        departure: the same from the surroundings' profile, moved and rolled as the row is.
        color: in the product's dtype.
        sigma: standard deviation of the deviation, mm, by the product's own; None where it has none.
    """

    row: int
    deviation: Float[Tensor, "rows cells"]
    departure: Float[Tensor, "rows cells"]
    color: Shaped[Tensor, "rows cells channels"]
    sigma: Float[Tensor, "rows cells"] | None

    @property
    def brightness(self) -> Float[Tensor, "rows cells"]:
        """Mean of the channels, float32; NaN where the product is black and has no height, as no line saw it."""
        mean = self.color.float().mean(-1)
        return mean.masked_fill((mean == 0) & ~self.departure.isfinite(), torch.nan)


def strip_of(
    source: ProductSource, profile: SurfaceProfile, unrolling: Unrolling, rows: range, config: SurfaceConfig
) -> SurfaceStrip:
    """Rows of the unrolled surface of a product."""
    columns, basis = profile.columns, profile.basis
    off = source.height(rows.start, rows.stop)[:, columns].double() - profile.height
    apart = off - profile.local(rows.start, rows.stop)
    place = basis.placed(apart)
    another = ~(place[:, :1].abs() <= config.largest_mm)  # NaN too
    deviation = off * profile.cosine
    departure = (apart - basis.raised(place)) * profile.cosine
    hidden = another | ~(departure.abs() <= config.largest_mm)
    sigma = None
    if source.has_sigma:
        across, _, up = source.sigma(rows.start, rows.stop)[:, columns].double().unbind(-1)
        sigma = torch.hypot(up, profile.slope * across) * profile.cosine
    return SurfaceStrip(
        rows.start,
        unrolling.taken(deviation.masked_fill(hidden, torch.nan)),
        unrolling.taken(departure.masked_fill(hidden, torch.nan)),
        unrolling.taken_color(source.color(rows.start, rows.stop)[:, columns]),
        None if sigma is None else unrolling.taken(sigma.masked_fill(hidden, torch.nan)),
    )


@dataclass(frozen=True)
class Surroundings:
    """Rows of the surface, the first of them ``row``, with ``halo`` rows before and after; NaN beyond the product."""

    row: int
    halo: int
    departure: Float[Tensor, "rows cells"]
    brightness: Float[Tensor, "rows cells"]

    @property
    def inner(self) -> slice:
        """The rows that are not of the halo."""
        return slice(self.halo, len(self.departure) - self.halo)


def with_neighbours(strips: Iterable[SurfaceStrip], halo: int) -> Iterator[Surroundings]:
    """Consecutive strips with the rows about them; each row of the product is read once.

    But for the first and the last they begin and end ``halo`` rows before those that were read.
    """
    row, held = 0, None
    for strip in strips:
        planes = torch.stack([strip.departure, strip.brightness])
        held = _beyond(planes, halo) if held is None else held
        joined = torch.cat([held, planes], dim=1)
        rows = joined.shape[1] - 2 * halo
        if rows > 0:
            yield Surroundings(row, halo, *joined)
            row += rows
        held = joined[:, max(rows, 0) :]
    if held is not None:
        joined = torch.cat([held, _beyond(held, halo)], dim=1)
        if joined.shape[1] > 2 * halo:
            yield Surroundings(row, halo, *joined)


def _beyond(planes: Float[Tensor, "2 rows cells"], halo: int) -> Float[Tensor, "2 halo cells"]:
    """Rows beyond the ends of the product."""
    return planes.new_full((2, halo, planes.shape[2]), torch.nan)
