"""The profile that an object has all along its product, and how it changes slowly from one end to the other.

A product is taken in pieces of the same length at places that depend on its size alone. Rows of a piece are aligned to
each other and give its profile; the pieces' profiles, aligned, give that of the product.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import LsvisionError
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.levelled import RowBasis
from lsvision.types import ProductGrid, ProductSource

_CROWN_SHARE = 0.95  # of a row's heights that lie about its crown, or lower
_ROUNDS = 3  # of aligning rows and taking their profile
_STEEPEST = 2.5  # slope beyond which neighbouring cells see too little of the surface
_SLOPE_REACH_MM = 0.4  # to either side of a place, over which its slope is taken
_LEAST_MEASURED = 0.5  # of the places between the ends of a profile
_READ_ROWS = 512


class NoProfileError(LsvisionError):
    """A product shows no object that is the same all along."""


@dataclass(frozen=True)
class SurfaceProfile:
    """The profile of an object on some columns of its product, and where its pieces depart from it.

    Attributes:
        columns: of the product that show it.
        q_x, height: of the profile, mm; linear over places that were not measured.
        measured: whether a place was.
        slope: its derivative. around: arc length from the crown, mm, growing with q_x.
        pieces: height of each piece's own profile over it, mm, but for how the piece lies; NaN where not measured.
        middle_rows: of the pieces.
    """

    columns: slice
    q_x: Float[Tensor, " columns"]
    height: Float[Tensor, " columns"]
    measured: Bool[Tensor, " columns"]
    slope: Float[Tensor, " columns"]
    around: Float[Tensor, " columns"]
    pieces: Float[Tensor, "pieces columns"]
    middle_rows: Float[Tensor, " pieces"]

    @property
    def basis(self) -> RowBasis:
        """What displacements do to it."""
        return RowBasis.of(self.q_x, self.height, self.slope.masked_fill(~self.measured, torch.nan))

    @property
    def cosine(self) -> Float[Tensor, " columns"]:
        """Of the angle of its normal with the height."""
        return torch.rsqrt(1 + self.slope.square())

    def local(self, start: int, stop: int) -> Float[Tensor, "rows columns"]:
        """Height of the surroundings' profile over the whole one's at rows, linear between the pieces' middles."""
        rows, pieces = torch.arange(start, stop).double(), self.pieces.nan_to_num()
        if len(pieces) == 1:
            return pieces.expand(len(rows), -1)
        after = torch.searchsorted(self.middle_rows, rows).clamp(1, len(pieces) - 1)
        first, last = self.middle_rows[after - 1], self.middle_rows[after]
        share = ((rows - first) / (last - first)).clamp(0.0, 1.0)
        return torch.lerp(pieces[after - 1], pieces[after], share[:, None])


def profile_of(source: ProductSource, config: SurfaceConfig) -> SurfaceProfile:
    """The profile of a product's object.

    Raises:
        NoProfileError: half of the product's pieces show no common profile.
    """
    grid = source.grid
    q_x = grid.q_x(slice(0, grid.columns))
    spans = _spans(grid, config)
    profiles = [_common(_rows_of(source, span), q_x, config) for span in spans]
    pieces = [(span, profile) for span, profile in zip(spans, profiles, strict=True) if profile is not None]
    whole = _whole(torch.stack([profile for _, profile in pieces]), q_x, config) if pieces else None
    if whole is not None:
        off = torch.stack([profile for _, profile in pieces])[:, whole.columns] - whole.height
        place = whole.basis.placed(off)
        of_it = place.isfinite().all(1) & (place[:, 0].abs() <= config.largest_mm)
        if int(of_it.sum()) >= len(spans) / 2:
            middles = torch.tensor([(span[0] + span[-1]) / 2 for span, _ in pieces], dtype=torch.float64)
            return replace(whole, pieces=(off - whole.basis.raised(place))[of_it], middle_rows=middles[of_it])
    raise NoProfileError("no profile that half of the product's length shows: there is nothing to compare rows with")


def _whole(
    pieces: Float[Tensor, "pieces columns"], q_x: Float[Tensor, " columns"], config: SurfaceConfig
) -> SurfaceProfile | None:
    """The profile that pieces have in common; None where that has more gaps than places."""
    height = _common(pieces, q_x, config)
    slope = None if height is None else _slope(height, float(q_x[1] - q_x[0]))
    if height is None or slope is None or not bool(slope.isfinite().any()):
        return None
    shown = slope.isfinite().nonzero()[:, 0]
    whole = _bridged(q_x, slice(int(shown[0]), int(shown[-1]) + 1), height, slope)
    return whole if float(whole.measured.double().mean()) >= _LEAST_MEASURED else None


def _spans(grid: ProductGrid, config: SurfaceConfig) -> list[list[int]]:
    """Rows of every piece, evenly spaced within it."""
    count = max(1, round(grid.rows * grid.pitch_mm / config.local_mm))
    edges = [index * grid.rows // count for index in range(count + 1)]
    return [
        sorted({first + part * (stop - first) // config.profile_rows for part in range(config.profile_rows)})
        for first, stop in pairwise(edges)
    ]


def _rows_of(source: ProductSource, rows: Sequence[int]) -> Float[Tensor, "rows columns"]:
    """Heights of single rows, float64."""
    parts = []
    for start in range(rows[0] // _READ_ROWS * _READ_ROWS, rows[-1] + 1, _READ_ROWS):
        wanted = [row for row in rows if start <= row < start + _READ_ROWS]
        if wanted:
            block = source.height(wanted[0], wanted[-1] + 1)
            parts.append(block[[row - wanted[0] for row in wanted]])
    return torch.cat(parts).double()


def _common(
    height: Float[Tensor, "rows columns"], q_x: Float[Tensor, " columns"], config: SurfaceConfig
) -> Float[Tensor, " columns"] | None:
    """Median of rows once they are aligned, where half of them were measured; None where nothing was."""
    seen = height.isfinite().any(0)
    if not bool(seen.any()):
        return None
    crown = height[:, seen].nanquantile(_CROWN_SHARE, dim=1)
    level = float(crown.nanmedian())
    height = height[(crown - level).abs() <= config.largest_mm]  # the others show another object
    aligned = height - (crown[(crown - level).abs() <= config.largest_mm] - level)[:, None]
    aligned = aligned.masked_fill(~(aligned >= level - config.profile_depth_mm - config.largest_mm), torch.nan)
    for _ in range(_ROUNDS):
        profile = _median(aligned)
        basis = RowBasis.of(q_x, profile, _slope(profile, float(q_x[1] - q_x[0])))
        aligned = aligned - basis.raised(basis.placed(aligned - profile)).nan_to_num()
    profile = _median(aligned)
    return profile.masked_fill(~(profile >= level - config.profile_depth_mm), torch.nan)


def _median(height: Float[Tensor, "rows columns"]) -> Float[Tensor, " columns"]:
    """Where half of the rows were measured."""
    return height.nanmedian(0).values.masked_fill(height.isfinite().sum(0) < len(height) / 2, torch.nan)


def _slope(height: Float[Tensor, " columns"], pitch_mm: float) -> Float[Tensor, " columns"]:
    """Derivative of a profile; NaN where it is too steep, or ends."""
    reach = max(1, round(_SLOPE_REACH_MM / pitch_mm))
    slope = torch.full_like(height, torch.nan)
    slope[reach:-reach] = (height[2 * reach :] - height[: -2 * reach]) / (2 * reach * pitch_mm)
    return slope.masked_fill(~(slope.abs() <= _STEEPEST), torch.nan)


def _bridged(q_x: Tensor, columns: slice, height: Tensor, slope: Tensor) -> SurfaceProfile:
    """The profile on columns, linear over gaps, without its pieces."""
    across, level, fall = q_x[columns], height[columns], slope[columns]
    known = (level.isfinite() & fall.isfinite()).nonzero()[:, 0]
    after = torch.searchsorted(known, torch.arange(len(across))).clamp(max=len(known) - 1)
    last, first = known[after], known[(after - 1).clamp(min=0)]
    share = (torch.arange(len(across)) - first) / (last - first).clamp(min=1)
    smooth = torch.lerp(level[first], level[last], share.double())
    smooth_slope = torch.lerp(fall[first], fall[last], share.double())
    measured = level.isfinite() & fall.isfinite()
    step = (1 + smooth_slope.square()).sqrt() * float(q_x[1] - q_x[0])
    around = (step[1:] + step[:-1]).cumsum(0) / 2
    around = torch.cat([around.new_zeros(1), around])
    around = around - around[int(smooth.argmax())]
    return SurfaceProfile(
        columns, across, smooth, measured, smooth_slope, around, smooth.new_zeros(0, len(across)), smooth.new_zeros(0)
    )
