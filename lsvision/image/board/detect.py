"""Checkerboards in images: the grid on a reduced copy, its order from the colours, its corners at full size."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.board.lattice import SeenLattice, find_saddle_lattice
from lsvision.image.board.order import order_grids, square_contrast
from lsvision.image.board.placement import LatticeView, place_board
from lsvision.image.board.refine import DetectedCorners, refine_grid
from lsvision.image.brightness import gray, gray_bytes
from lsvision.image.missing import missing_mask, missing_near
from lsvision.types import Board, LineImage, TensorImage, missing_ranges

_REDUCED_WIDTH = 900  # columns in which the coarse search runs: squares of a full-field board still have 40 px
_REDUCED_RADIUS = 6  # of windows of the reduced copy, px
_RIM_PX = 8  # of the reduced copy: nearer to its rim a saddle may be missed
_FEWEST_OF_OPENCV = 3  # corners along a side of the boards that it looks for
_REDUCE_LINES = 64  # as many as stay in the processor's cache


@dataclass(frozen=True)
class SeenBoard:
    """A board on the reduced copy of an image: its lattice, before it is known which corner is which.

    ``hidden`` are the lines of the copy that are missing or cut off by missing ones, None where none are missing.
    """

    lattice: SeenLattice
    brightness: Float[Tensor, "lines width"]
    factor: int
    hidden: Bool[Tensor, " lines"] | None = None

    def in_image(self) -> SeenLattice:
        """The lattice in px of the whole image, good to some tenths of a pixel of the copy."""
        return self.lattice.enlarged(self.factor)

    def with_nodes(self, lattice: SeenLattice) -> "SeenBoard":
        """The same corners, counted as those of another lattice are."""
        return dataclasses.replace(self, lattice=SeenLattice(lattice.node, self.lattice.position))

    def black_parity(self) -> int:
        """0 where the square from corner (0, 0) to (1, 1) is black, 1 where it is white."""
        first, last = self.lattice.node.amin(0), self.lattice.node.amax(0)
        x, y = (torch.arange(int(low), int(high) + 1) for low, high in zip(first, last, strict=True))
        grid = self.lattice.to_image()(torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).double())
        first_is_white = square_contrast(grid, self.brightness) < 0
        return (int(first.sum()) + first_is_white) % 2

    def view(self) -> LatticeView:
        """For the search of the board's place on the lattice."""
        lines, width = self.brightness.shape
        return LatticeView(self.lattice, (lines, width), _RIM_PX, self.hidden)


def detect_board(image: LineImage, board: Board, *, mirrored: bool = False) -> DetectedCorners | None:
    """Find a board in an image of any length and locate its inner corners.

    Args:
        image: read by line ranges, twice: reduced for the search, then a window around each corner.
        mirrored: the image is the mirror image of the object (reversed transport).

    Returns:
        Corners in the order of ``Board.corner_points``, or None where there is no board.
    """
    seen = look_for_board(image, board)
    located = locate_corners([image], [seen], board, mirrored=mirrored) if seen else None
    return located[0] if located else None


def look_for_board(image: LineImage, board: Board) -> SeenBoard | None:
    """The board's lattice on a reduced copy of an image; None where there is none."""
    factor = max(1, round(image.shape[1] / _REDUCED_WIDTH))
    reduced = reduce_image(image, factor)
    lattice = find_lattice(reduced, board.inner)
    if not missing_ranges(image):
        return SeenBoard(lattice, reduced, factor) if lattice is not None else None
    missing = _missing_lines(image, factor)
    if lattice is not None and bool(missing[_extent(lattice)].any()):
        # A row of corners may be among them: they are counted on one side alone.
        lattice = find_saddle_lattice(reduced, math.prod(board.inner), missing_near(missing, _RIM_PX))
    if lattice is None:
        return None
    return SeenBoard(lattice, reduced, factor, _cut_off(missing, _extent(lattice)))


def _missing_lines(image: LineImage, factor: int) -> Bool[Tensor, " lines"]:
    """Lines of the reduced copy that are not there."""
    lines = image.shape[0] // factor * factor
    return missing_mask(image, torch.arange(lines)).reshape(-1, factor).any(-1)


def _extent(lattice: SeenLattice) -> slice:
    """The lines from the first corner of a lattice to the last."""
    first, last = torch.aminmax(lattice.position[:, 1])
    return slice(max(int(first), 0), int(last) + 1)


def _cut_off(missing: Bool[Tensor, " lines"], seen: slice) -> Bool[Tensor, " lines"]:
    """Missing lines and whatever lies beyond them from those that are seen: corners there were not looked for."""
    beyond = missing.clone()
    before, after = missing[: seen.start].nonzero(), missing[seen.stop :].nonzero()
    if len(before):
        beyond[: int(before[-1])] = True
    if len(after):
        beyond[seen.stop + int(after[0]) :] = True
    return beyond


def locate_corners(
    images: Sequence[LineImage], seen: Sequence[SeenBoard], board: Board, *, mirrored: bool = False
) -> list[DetectedCorners] | None:
    """Corners of one board in one image or several, to a fraction of a pixel, in the order of ``Board.corner_points``.

    Args:
        seen: the board in each of the images, with lattices that count from the same corner along the same axes.

    Returns:
        Corners of each image; None where too few of a board are seen.
    """
    grids = place_board([found.view() for found in seen], board.inner)
    if grids is None:
        return None
    grids = order_grids(grids, [found.brightness for found in seen], mirrored=mirrored)
    return [_refined(image, found, grid) for image, found, grid in zip(images, seen, grids, strict=True)]


def _refined(image: LineImage, seen: SeenBoard, grid: Tensor) -> DetectedCorners:
    if seen.factor > 1:
        # A tenth of a pixel of the copy is already a pixel of the image; the fit of the copy is better than that.
        copy = TensorImage(seen.brightness[..., None])
        coarse = refine_grid(copy, grid, largest_radius=_REDUCED_RADIUS, plain=True)
        grid = torch.where(coarse.valid[:, None], coarse.position, grid.reshape(-1, 2)).reshape(grid.shape)
    return refine_grid(image, (grid + 0.5) * seen.factor - 0.5)


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


def find_lattice(brightness: Float[Tensor, "lines width"], inner: tuple[int, int]) -> SeenLattice | None:
    """Corners of a board, all or those that are seen, as nodes of a lattice; None where no board is seen."""
    if min(brightness.shape) < 2 * max(inner):
        return None
    # OpenCV's need every corner, and miss boards at some angles and shears.
    found = _found_by_opencv(brightness, inner) if min(inner) >= _FEWEST_OF_OPENCV else None
    return found if found is not None else find_saddle_lattice(brightness, inner[0] * inner[1])


def _found_by_opencv(brightness: Float[Tensor, "lines width"], inner: tuple[int, int]) -> SeenLattice | None:
    picture = stretch_to_bytes(brightness).numpy()
    found, corners = cv2.findChessboardCornersSB(
        picture, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    )
    if not found:
        found, corners = cv2.findChessboardCorners(
            picture, inner, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
    return SeenLattice.of_grid(_as_grid(corners, inner)) if found else None


def stretch_to_bytes(brightness: Float[Tensor, "lines width"]) -> UInt8[Tensor, "lines width"]:
    """Grey values from 0 at the darkest pixel to 255 at the brightest."""
    low, high = torch.aminmax(brightness)
    return ((brightness - low) * (255.0 / max(float(high - low), 1e-6))).to(torch.uint8)


def _as_grid(corners: NDArray, inner: tuple[int, int]) -> Tensor:
    # OpenCV 4 returns (N, 1, 2), OpenCV 5 (N, 2).
    points = torch.from_numpy(np.asarray(corners, dtype=np.float64).reshape(-1, 2))
    return points.reshape(inner[1], inner[0], 2)
