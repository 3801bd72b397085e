"""Checkerboards in images: the grid on a reduced copy, its order from the colours, its corners at full size."""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.board.lattice import find_saddle_grid
from lsvision.image.board.order import order_grid
from lsvision.image.board.refine import DetectedCorners, refine_grid
from lsvision.image.brightness import gray, gray_bytes
from lsvision.types import Board, LineImage, TensorImage

_REDUCED_WIDTH = 900  # columns in which the coarse search runs: squares of a full-field board still have 40 px
_REDUCED_RADIUS = 6  # of windows of the reduced copy, px
_REDUCE_LINES = 64  # as many as stay in the processor's cache


def detect_board(image: LineImage, board: Board, *, mirrored: bool = False) -> DetectedCorners | None:
    """Find a board in an image of any length and locate its inner corners.

    Args:
        image: read by line ranges, twice: reduced for the search, then a window around each corner.
        mirrored: the image is the mirror image of the object (reversed transport).

    Returns:
        Corners in the order of ``Board.corner_points``, or None where there is no board.
    """
    factor = max(1, round(image.shape[1] / _REDUCED_WIDTH))
    reduced = reduce_image(image, factor)
    grid = find_grid(reduced, board.inner)
    if grid is None:
        return None
    ordered = order_grid(grid, reduced, mirrored=mirrored)
    if factor > 1:
        # A tenth of a pixel of the copy is already a pixel of the image; the fit of the copy is better than that.
        coarse = refine_grid(TensorImage(reduced[..., None]), ordered, largest_radius=_REDUCED_RADIUS, plain=True)
        ordered = torch.where(coarse.valid[:, None], coarse.position, ordered.reshape(-1, 2)).reshape(ordered.shape)
    return refine_grid(image, (ordered + 0.5) * factor - 0.5)


def reduce_image(image: LineImage, factor: int) -> Float[Tensor, "lines width"]:
    """Brightness of an image averaged over blocks of ``factor x factor`` px; an incomplete last block is left out.

    An image of bytes is averaged in whole grey values: the rounding is less than its noise.
    """
    lines, width, _ = image.shape
    kept = width - width % factor
    brightness = gray_bytes if image.dtype == torch.uint8 else gray
    blocks = []
    step = max(factor, _REDUCE_LINES - _REDUCE_LINES % factor)
    for start in range(0, lines - lines % factor, step):
        stop = min(start + step, lines - lines % factor)
        whole = brightness(image.read(start, stop))[:, :kept].numpy()
        # 0.11 ms on 64 x 7136 px; kornia's resize by area takes 0.27 ms and differs by the rounding alone.
        blocks.append(cv2.resize(whole, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA))
    return torch.from_numpy(np.concatenate(blocks)).float() if blocks else torch.zeros(0, kept // factor)


def find_grid(
    brightness: Float[Tensor, "lines width"], inner: tuple[int, int]
) -> Float[Tensor, "rows columns 2"] | None:
    """Inner corners of a board as a grid of (u, v) px, columns along the longer side; None where none is seen.

    Where a board is partly hidden or beyond the image, the grid continues where its corners would be. The order along
    either side, and so the handedness, is undetermined: ``order_grid`` settles it.
    """
    if min(brightness.shape) < 2 * max(inner):
        return None
    picture = stretch_to_bytes(brightness).numpy()
    found, corners = cv2.findChessboardCornersSB(
        picture, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    )
    if not found:
        found, corners = cv2.findChessboardCorners(
            picture, inner, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
    # Both need every corner, and miss boards at some angles and shears.
    return _as_grid(corners, inner) if found else find_saddle_grid(brightness, inner)


def stretch_to_bytes(brightness: Float[Tensor, "lines width"]) -> UInt8[Tensor, "lines width"]:
    """Grey values from 0 at the darkest pixel to 255 at the brightest."""
    low, high = torch.aminmax(brightness)
    return ((brightness - low) * (255.0 / max(float(high - low), 1e-6))).to(torch.uint8)


def _as_grid(corners: NDArray, inner: tuple[int, int]) -> Tensor:
    # OpenCV 4 returns (N, 1, 2), OpenCV 5 (N, 2).
    points = torch.from_numpy(np.asarray(corners, dtype=np.float64).reshape(-1, 2))
    return points.reshape(inner[1], inner[0], 2)
