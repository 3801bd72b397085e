"""Robust values of a noisy map at given points, by a plane fitted around each."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.types import LineImage

_ROUNDS = 4  # of reweighting, each of which removes nine tenths of the outliers' pull
_OUTLIER = 4.5  # median absolute deviations: three sigmas of a normal distribution
_SMALLEST_SHARE = 0.25  # of the window that must lie on the plane


@dataclass(frozen=True)
class LocalPlanes:
    """Planes at their points.

    Attributes:
        value: of the plane at the point.
        slope: of the plane along columns and along lines, per px: by it an error of the point becomes one of the value.
        variance: of the value where the point is exact, from the residuals and the rounding of the map.
        valid: whether enough of the window lay on the plane.
    """

    value: Float[Tensor, " points"]
    slope: Float[Tensor, "points 2"]
    variance: Float[Tensor, " points"]
    valid: Bool[Tensor, " points"]


@dataclass(frozen=True)
class MapWindows:
    """Windows of a map around points, one row of pixels each; values are 0 where they are not valid.

    ``design`` holds (1, column, line) of each pixel, px from its point: a plane's first coefficient is its value there.
    """

    values: Float[Tensor, "points pixels"]
    valid: Bool[Tensor, "points pixels"]
    design: Float[Tensor, "points pixels 3"]


@dataclass(frozen=True)
class WeightedPlanes:
    """Planes of weighted least squares through windows, and their normal matrices."""

    coefficients: Float[Tensor, "points 3 1"]
    normal: Float[Tensor, "points 3 3"]

    @classmethod
    def through(cls, windows: MapWindows, weight: Float[Tensor, "points pixels"]) -> "WeightedPlanes":
        """Fit a plane to each window."""
        # Weak enough to change nothing, strong enough that an empty window stays solvable.
        ridge = 1e-9 * torch.eye(3, dtype=weight.dtype, device=weight.device)
        normal = windows.design.mT @ (weight[..., None] * windows.design) + ridge
        pull = windows.design.mT @ (weight * windows.values)[..., None]
        return cls(torch.linalg.solve(normal, pull), normal)

    def residual(self, windows: MapWindows) -> Float[Tensor, "points pixels"]:
        """Distances of the values from the planes."""
        return (windows.values - (windows.design @ self.coefficients)[..., 0]).abs()

    def value(self) -> Float[Tensor, " points"]:
        """The planes at their points."""
        return self.coefficients[:, 0, 0]

    def slope(self) -> Float[Tensor, "points 2"]:
        """The planes' slopes along columns and along lines."""
        return self.coefficients[:, 1:, 0]

    def value_variance(self) -> Float[Tensor, " points"]:
        """Variance of the value, per variance of a pixel."""
        return torch.linalg.inv(self.normal)[:, 0, 0]


def fit_local_planes(
    image: LineImage,
    position: Float[Tensor, "points 2"],
    wanted: Bool[Tensor, " points"],
    half_size: tuple[int, int],
) -> LocalPlanes:
    """Value of a one-channel map at positions (column, line), px, by least squares on a plane without its outliers.

    Args:
        image: float map, NaN where it is invalid.
        wanted: points to evaluate; the positions of the others may be NaN.
        half_size: half the window in columns and in lines, px.

    Returns:
        Values, valid where wanted and at least a quarter of the window lay on the plane.
    """
    windows = read_map_windows(image, torch.where(wanted[:, None], position, 0.0), wanted, half_size)
    rounding = Rounding.of(windows, torch.finfo(image.dtype).eps)
    kept = _without_outliers(windows, rounding.step).to(windows.values.dtype)
    planes = WeightedPlanes.through(windows, kept)
    count = kept.sum(-1)
    variance = (kept * planes.residual(windows).square()).sum(-1) / (count - 3).clamp(min=1)
    valid = wanted & (count >= _SMALLEST_SHARE * kept.shape[1])
    variance = variance * planes.value_variance() + rounding.variance(windows.values, kept > 0)
    return LocalPlanes(planes.value(), planes.slope(), variance, valid)


@dataclass(frozen=True)
class Rounding:
    """Rounding of a map's values: to steps of ``step``, and to the ``precision`` of its numbers at least."""

    step: Float[Tensor, ""]
    precision: Float[Tensor, ""]

    @classmethod
    def of(cls, windows: MapWindows, eps: float) -> "Rounding":
        """The step is the smallest difference between any two values; a map that is the same everywhere shows none.

        Args:
            eps: relative precision of the map's numbers.
        """
        values = windows.values[windows.valid]
        if values.numel() == 0:
            return cls(values.new_zeros(()), values.new_zeros(()))
        precision = eps * values.abs().max()
        differences = values.unique().diff()
        return cls(torch.maximum(differences.min(), precision) if differences.numel() else precision, precision)

    def variance(self, values: Tensor, kept: Tensor) -> Float[Tensor, " points"]:
        """Variance that rounding adds to the value of a plane and that the residuals do not show.

        All pixels of a flat window are rounded alike, so that the plane is as wrong as one of them. Over a window that
        spans m steps the errors cancel, less than those of independent pixels do: slopes near a whole number of steps
        leave rows that are rounded alike.

        Args:
            values: pixels of windows, (points, pixels).
            kept: those that the plane was fitted to.
        """
        highest = torch.where(kept, values, -torch.inf).amax(-1)
        lowest = torch.where(kept, values, torch.inf).amin(-1)
        spanned = ((highest - lowest) / self.step).clamp(min=1)
        return (self.step.square() / spanned + self.precision.square()) / 12


def _without_outliers(windows: MapWindows, step: Tensor) -> Tensor:
    """Valid pixels (points, pixels) near the plane of a robust fit, by iterated reweighting.

    Rounding to steps is no outlier: its errors are uniform, with the median step / 4.
    """
    weight = windows.valid.to(windows.values.dtype)
    for _ in range(_ROUNDS):
        residual = WeightedPlanes.through(windows, weight).residual(windows)
        median = torch.where(windows.valid, residual, torch.nan).nanmedian(-1, keepdim=True).values + step / 4 + 1e-9
        # Cauchy's weights: a cut at once would keep outliers that have drawn the plane halfway to them.
        weight = windows.valid / (1.0 + (residual / median).square())
    return windows.valid & (residual <= _OUTLIER * median)


def read_map_windows(
    image: LineImage,
    position: Float[Tensor, "points 2"],
    wanted: Bool[Tensor, " points"],
    half_size: tuple[int, int],
) -> MapWindows:
    """Windows of ``2 half + 1`` columns and lines around (column, line); only lines near wanted points are read."""
    lines, width, _ = image.shape
    half_columns, half_lines = half_size
    centre = position.round().long()
    du, dv = torch.meshgrid(
        torch.arange(-half_columns, half_columns + 1), torch.arange(-half_lines, half_lines + 1), indexing="xy"
    )
    column, line = centre[:, 0, None, None] + du, centre[:, 1, None, None] + dv
    rows = centre[wanted, 1] if bool(wanted.any()) else centre.new_zeros(1)
    first, last = max(int(rows.min()) - half_lines, 0), min(int(rows.max()) + half_lines + 1, lines)
    strip = image.read(first, last)[..., 0].to(position.dtype)
    inside = (column >= 0) & (column < width) & (line >= first) & (line < last)
    values = strip[line.clamp(first, last - 1) - first, column.clamp(0, width - 1)].flatten(1)
    valid = inside.flatten(1) & torch.isfinite(values)
    offset = torch.stack([column - position[:, 0, None, None], line - position[:, 1, None, None]], dim=-1)
    design = torch.cat([torch.ones_like(offset[..., :1]), offset], dim=-1).flatten(1, 2)
    return MapWindows(torch.where(valid, values, 0.0), valid, design)
