"""The order of a checkerboard's corners, from the colours of its squares."""

from collections.abc import Sequence

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor


def order_grids(
    grids: Sequence[Float[Tensor, "rows columns 2"]],
    images: Sequence[Float[Tensor, "lines width"]],
    *,
    mirrored: bool = False,
) -> list[Float[Tensor, "rows columns 2"]]:
    """Turn grids so that X runs from the side with two black corner squares and the frame is right-handed.

    The squares between the corners decide: in the right order the square beside the origin is black, as is every
    second one. A board whose sides have an even sum of squares looks the same upside down; it keeps the order in which
    X runs towards larger columns.

    Args:
        grids: of one board in several images, in the same order of corners; all are turned alike.
        images: their brightness.
        mirrored: the images are mirror images of the object.
    """
    x, y = (torch.stack([_mean_step(grid, dim) for grid in grids]).mean(0) for dim in (1, 0))
    if bool(x[0] * y[1] - x[1] * y[0] > 0) == mirrored:
        grids = [grid.flip(0) for grid in grids]
    turned = [grid.flip(0, 1) for grid in grids]
    smooth = [torch.from_numpy(cv2.blur(image.numpy(), (3, 3))) for image in images]
    contrast, turned_contrast = (
        sum(square_contrast(grid, image) for grid, image in zip(way, smooth, strict=True)) for way in (grids, turned)
    )
    if abs(contrast - turned_contrast) < 1e-6 * (abs(contrast) + abs(turned_contrast)):
        return list(grids) if bool(x[0] >= 0) else turned
    return list(grids) if contrast > turned_contrast else turned


def order_grid(
    grid: Float[Tensor, "rows columns 2"], brightness: Float[Tensor, "lines width"], *, mirrored: bool = False
) -> Float[Tensor, "rows columns 2"]:
    """``order_grids`` of one image."""
    return order_grids([grid], [brightness], mirrored=mirrored)[0]


def _mean_step(grid: Tensor, dim: int) -> Tensor:
    return grid.diff(dim=dim).mean((0, 1))


def square_contrast(grid: Float[Tensor, "rows columns 2"], brightness: Float[Tensor, "lines width"]) -> float:
    """How much brighter the white squares between the corners are than the black ones, in the order of a grid."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    scale = torch.tensor([max(n - 1, 1) for n in (brightness.shape[1], brightness.shape[0])], dtype=torch.float64)
    normalised = (2 * centres / scale - 1).to(torch.float32)
    seen = F.grid_sample(brightness[None, None], normalised[None], align_corners=True)[0, 0]
    row, column = torch.meshgrid(torch.arange(seen.shape[0]), torch.arange(seen.shape[1]), indexing="ij")
    black = (row + column) % 2 == 0
    inside = (normalised.abs() <= 1).all(-1)
    if not bool((black & inside).any() and (~black & inside).any()):
        return 0.0
    return float(seen[~black & inside].mean() - seen[black & inside].mean())
