"""Robust values of a noisy map at given points, by a plane fitted around each."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.types import LineImage

_ROUNDS = 4  # of reweighting, each of which takes nine tenths of what outliers pull
# A residual beyond 4.5 median deviations is three sigmas out for a normal distribution.
_OUTLIER = 4.5
_SMALLEST_SHARE = 0.25  # of the window that must lie on the plane


def fit_local_planes(
    image: LineImage,
    position: Float[Tensor, "points 2"],
    wanted: Bool[Tensor, " points"],
    half_size: tuple[int, int],
) -> tuple[Float[Tensor, " points"], Float[Tensor, " points"], Bool[Tensor, " points"]]:
    """Value of a one-channel map at positions (column, line), px, by least squares on a plane without its outliers.

    Args:
        image: float map, NaN for none.
        wanted: points to evaluate; the positions of the others may be NaN.
        half_size: half the window in columns and in lines, px.

    Returns:
        Value, its variance from the residuals, and whether at least a quarter of the window lay on the plane.
    """
    safe = torch.where(wanted[:, None], position, 0.0)
    values, usable, offset = _gather_windows(image, safe, wanted, half_size)
    design = torch.cat([torch.ones_like(offset[..., :1]), offset], dim=-1)
    weight = usable.to(values.dtype)
    for _ in range(_ROUNDS):
        plane, _ = _weighted_plane(design, values, weight)
        residual, spread = _residuals(design, values, plane, usable)
        # Cauchy's weights: a cut at once would keep outliers that have drawn the plane halfway to them.
        weight = usable / (1.0 + (residual / spread).square())
    kept = (usable & (residual <= _OUTLIER * spread)).to(values.dtype)
    plane, normal = _weighted_plane(design, values, kept)
    residual, _ = _residuals(design, values, plane, usable)
    count = kept.sum(-1)
    variance = (kept * residual.square()).sum(-1) / (count - 3).clamp(min=1)
    variance = variance * torch.linalg.inv(normal)[:, 0, 0]
    return plane[:, 0, 0], variance, wanted & (count >= _SMALLEST_SHARE * design.shape[1])


def _weighted_plane(design: Tensor, values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Planes (points, 3, 1) of least squares and their normal matrices."""
    # Weak enough to change nothing, strong enough that an empty window stays solvable.
    ridge = 1e-9 * torch.eye(3, dtype=values.dtype)
    normal = design.mT @ (weight[..., None] * design) + ridge
    return torch.linalg.solve(normal, design.mT @ (weight * values)[..., None]), normal


def _residuals(design: Tensor, values: Tensor, plane: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Distances of values from planes, (points, pixels), and their median, (points, 1)."""
    residual = (values - (design @ plane)[..., 0]).abs()
    spread = torch.where(usable, residual, torch.nan).nanmedian(-1, keepdim=True).values
    return residual, spread + 1e-9  # rounding is not an outlier


def _gather_windows(
    image: LineImage, position: Tensor, wanted: Tensor, half_size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Values (points, pixels) with 0 where there is none, which are usable, and the offset of each from its point."""
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
    usable = inside.flatten(1) & torch.isfinite(values)
    offset = torch.stack([column - position[:, 0, None, None], line - position[:, 1, None, None]], dim=-1)
    return torch.where(usable, values, 0.0), usable, offset.flatten(1, 2)
