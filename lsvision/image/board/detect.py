"""Checkerboards in images: the grid on a reduced copy, its order from the colours, its corners at full size."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.lattice import find_saddle_grid
from lsvision.image.board.saddle import SaddleFit, fit_saddles
from lsvision.image.brightness import gray, gray_bytes
from lsvision.types import Board, LineImage, TensorImage

_REDUCED_WIDTH = 900  # columns in which the coarse search runs: squares of a full-field board still have 40 px
_READ_LINES = 512
_REDUCE_LINES = 64  # as many as stay in the processor's cache
_INTO_SQUARES = 0.4  # share of a square that a window takes in: blur and shift stay clear of the next edges
# How far the fit of a window may be from the board's median: a corner under glare, smear or dirt is another picture.
_WORST_RESIDUAL, _WORST_BLUR, _LEAST_CONTRAST = 3.0, 2.0, 0.3


@dataclass(frozen=True)
class DetectedCorners:
    """Corners of one board in one image, in the board's order: (column, line) px, covariance px², seen or not."""

    position: Float[Tensor, "corners 2"]
    covariance: Float[Tensor, "corners 2 2"]
    valid: Bool[Tensor, " corners"]


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
        coarse = refine_grid(TensorImage(reduced[..., None]), ordered, largest_radius=6, plain=True)
        ordered = torch.where(coarse.valid[:, None], coarse.position, ordered.reshape(-1, 2)).reshape(ordered.shape)
    return refine_grid(image, (ordered + 0.5) * factor - 0.5)


def reduce_image(image: LineImage, factor: int) -> Float[Tensor, "lines width"]:
    """Brightness of an image averaged over blocks of ``factor x factor`` px; an incomplete last block is left out.

    Of an image of bytes it is in whole grey values: what that rounds off is less than their noise.
    """
    lines, width, _ = image.shape
    kept = width - width % factor
    blocks = []
    step = max(factor, _REDUCE_LINES - _REDUCE_LINES % factor)
    for start in range(0, lines - lines % factor, step):
        stop = min(start + step, lines - lines % factor)
        whole = (gray_bytes if image.dtype == torch.uint8 else gray)(image.read(start, stop))[:, :kept].numpy()
        blocks.append(cv2.resize(whole, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA))
    return torch.from_numpy(np.concatenate(blocks)).float() if blocks else torch.zeros(0, kept // factor)


def find_grid(
    brightness: Float[Tensor, "lines width"], inner: tuple[int, int]
) -> Float[Tensor, "rows columns 2"] | None:
    """Inner corners of a board as a grid of (u, v) px, columns along the longer side; None where none is seen.

    Of a board that is partly hidden or beyond the image the grid continues where its corners would be. The order along
    either side, and so the handedness, is left open: ``order_grid`` settles it.
    """
    if min(brightness.shape) < 2 * max(inner):
        return None
    picture = _stretched_to_bytes(brightness)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(picture, inner, flags=flags)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(picture, inner, flags=flags)
    if not found:  # both want every corner, and give up on some angles and shears
        return find_saddle_grid(brightness, inner)
    # OpenCV 4 returns (N, 1, 2), OpenCV 5 (N, 2).
    points = torch.from_numpy(np.asarray(corners, dtype=np.float64).reshape(-1, 2))
    return points.reshape(inner[1], inner[0], 2)


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
    score, turned_score = _pattern_score(grid, smooth), _pattern_score(turned, smooth)
    if abs(score - turned_score) < 1e-6 * (abs(score) + abs(turned_score)):
        return grid if bool(x[0] >= 0) else turned
    return grid if score > turned_score else turned


def refine_grid(
    image: LineImage, grid: Float[Tensor, "rows columns 2"], *, largest_radius: int = 13, plain: bool = False
) -> DetectedCorners:
    """Locate corners at full size, from a grid good to about two pixels: one batch of windows, fitted together.

    A window reaches into the four squares around its corner, at any angle, shear and stretch, and at most
    ``largest_radius`` px: past it the board's own texture weighs more than what is gained. A ``plain`` fit is a start.
    """
    points = grid.reshape(-1, 2)
    along_x, along_y = _neighbour_vectors(grid)
    extent = _INTO_SQUARES * (along_x.abs() + along_y.abs()).amax()
    radius = int(extent.ceil().clamp(3, largest_radius))
    centre = points.round().long()
    windows, inside = _windows(image, centre, radius)
    mask = _within_squares(torch.stack([along_x, along_y], dim=-1), radius)
    # The edge along X has its normal a quarter turn from the tangent along X.
    angles = torch.stack([torch.atan2(d[:, 1], d[:, 0]) + torch.pi / 2 for d in (along_x, along_y)], dim=-1)
    fit = fit_saddles(windows, angles.to(windows), mask, plain=plain)
    return _detected(fit, centre, inside)


def _within_squares(steps: Tensor, radius: int) -> Tensor:
    """Pixels (corners, size, size) of windows that lie well within the four squares around their corners."""
    span = torch.arange(-radius, radius + 1, dtype=steps.dtype)
    offset = torch.stack(torch.meshgrid(span, span, indexing="xy")).flatten(1)
    share = torch.linalg.solve(steps, offset.expand(len(steps), 2, -1))
    size = 2 * radius + 1
    mask = (share.abs() < _INTO_SQUARES).all(1).unflatten(-1, (size, size))
    # Corners closer than four pixels leave too few pixels to fit anything to: then the whole window has to do.
    return mask | (mask.sum((1, 2)) < 49)[:, None, None]


def _detected(fit: SaddleFit, centre: Tensor, inside: Tensor) -> DetectedCorners:
    """Corners whose windows look like those of the rest of the board: smear, glare and what lies over it do not."""
    valid = fit.valid & inside
    valid = valid & (fit.residual / fit.contrast < _WORST_RESIDUAL * _median(fit.residual / fit.contrast, valid))
    valid = valid & (fit.blur_px < _WORST_BLUR * _median(fit.blur_px, valid))
    valid = valid & (fit.contrast > _LEAST_CONTRAST * _median(fit.contrast, valid))
    # The surface's texture is the same all over the board, and one window tells too little about it.
    gain = fit.correlation_gain[valid].mean()
    position = torch.where(valid[:, None], centre + fit.position, torch.nan)
    covariance = torch.where(valid[:, None, None], gain * fit.covariance, torch.nan)
    return DetectedCorners(position, covariance, valid)


def _median(values: Tensor, valid: Tensor) -> Tensor:
    return torch.where(valid, values, torch.nan).nanmedian()


def _windows(image: LineImage, centre: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Square windows (corners, size, size), float64, and which of them lie within the image."""
    lines, width, _ = image.shape
    inside = ((centre >= radius) & (centre < torch.tensor([width, lines]) - radius)).all(-1)
    size = 2 * radius + 1
    windows = torch.zeros(centre.shape[0], size, size, dtype=torch.float64)
    span = torch.arange(size) - radius
    for start in range(0, lines, _READ_LINES):
        here = inside & (centre[:, 1] - radius >= start) & (centre[:, 1] - radius < start + _READ_LINES)
        if not bool(here.any()):
            continue
        strip = image.read(start, min(lines, start + _READ_LINES + size))
        rows = (centre[here, 1, None] + span - start)[:, :, None]
        columns = (centre[here, 0, None] + span)[:, None, :]
        windows[here] = gray(strip[rows, columns]).to(torch.float64)
    return windows, inside


def _neighbour_vectors(grid: Tensor) -> tuple[Tensor, Tensor]:
    """Step to the next corner along X and along Y, (corners, 2) each: central differences, one-sided at the rim."""
    along_y, along_x = torch.gradient(grid, dim=(0, 1))
    return along_x.reshape(-1, 2), along_y.reshape(-1, 2)


def _pattern_score(grid: Tensor, brightness: Tensor) -> float:
    """How much darker the squares are that should be black, if this were the right order."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    scale = torch.tensor([max(n - 1, 1) for n in (brightness.shape[1], brightness.shape[0])], dtype=torch.float64)
    normalised = (2 * centres / scale - 1).to(torch.float32)
    seen = F.grid_sample(brightness[None, None], normalised[None], align_corners=True)[0, 0]
    row, column = torch.meshgrid(torch.arange(seen.shape[0]), torch.arange(seen.shape[1]), indexing="ij")
    black = (row + column) % 2 == 0
    inside = (normalised.abs() <= 1).all(-1)
    return float(seen[~black & inside].mean() - seen[black & inside].mean())


def _stretched_to_bytes(brightness: Tensor) -> np.ndarray:
    low, high = torch.aminmax(brightness)
    return ((brightness - low) * (255.0 / max(float(high - low), 1e-6))).to(torch.uint8).numpy()
