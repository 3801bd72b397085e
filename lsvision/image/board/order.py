"""The order of a checkerboard's corners, from the colours of its squares."""

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor


def order_grid(
    grid: Float[Tensor, "rows columns 2"], brightness: Float[Tensor, "lines width"], *, mirrored: bool = False
) -> Float[Tensor, "rows columns 2"]:
    """Turn a grid so that X runs from the side with two black corner squares and the frame is right-handed.

    The squares between the corners decide: in the right order the square beside the origin is black, as is every
    second one. A board whose sides have an even sum of squares looks the same upside down; it keeps the order in which
    X runs towards larger columns.
    """
    x, y = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
    right_handed = bool(x[0] * y[1] - x[1] * y[0] > 0)
    if right_handed == mirrored:
        grid = grid.flip(0)
    smooth = torch.from_numpy(cv2.blur(brightness.numpy(), (3, 3)))
    turned = grid.flip(0, 1)
    contrast, turned_contrast = square_contrast(grid, smooth), square_contrast(turned, smooth)
    if abs(contrast - turned_contrast) < 1e-6 * (abs(contrast) + abs(turned_contrast)):
        return grid if bool(x[0] >= 0) else turned
    return grid if contrast > turned_contrast else turned


def square_contrast(grid: Float[Tensor, "rows columns 2"], brightness: Float[Tensor, "lines width"]) -> float:
    """How much brighter the white squares between the corners are than the black ones, in the order of a grid."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    scale = torch.tensor([max(n - 1, 1) for n in (brightness.shape[1], brightness.shape[0])], dtype=torch.float64)
    normalised = (2 * centres / scale - 1).to(torch.float32)
    seen = F.grid_sample(brightness[None, None], normalised[None], align_corners=True)[0, 0]
    row, column = torch.meshgrid(torch.arange(seen.shape[0]), torch.arange(seen.shape[1]), indexing="ij")
    black = (row + column) % 2 == 0
    inside = (normalised.abs() <= 1).all(-1)
    return float(seen[~black & inside].mean() - seen[black & inside].mean())
