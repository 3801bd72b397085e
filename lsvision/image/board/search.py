"""A checkerboard somewhere in a metric image of any length: searched part by part, in memory that does not grow."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.board.detect import detect_board, reduce_image
from lsvision.image.board.lattice import Lattice, grow_lattice
from lsvision.image.board.refine import DetectedCorners
from lsvision.image.board.saddle_points import find_saddle_points
from lsvision.types import Board, LineImage, TensorImage

_REACH = 1.1  # boards' diagonals that a board can be long, however it is turned and stretched
_SHORT = 4  # such lengths that are searched at once
_FEWEST_PX, _SQUARE_PX = 8, 10  # of a square in the copies that are searched for its lattice: least, and aimed at
_SEEDS, _SEEN_SHARE = 8, 0.5  # strongest saddles that a lattice is grown from, and the squares that it must have
_READ_LINES = 512


@dataclass(frozen=True)
class ImagePart:
    """Lines ``start..stop-1`` of an image as an image."""

    image: LineImage
    start: int
    stop: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        _, width, channels = self.image.shape
        return self.stop - self.start, width, channels

    @property
    def dtype(self) -> torch.dtype:
        """That of the image."""
        return self.image.dtype

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1`` of the part."""
        return self.image.read(self.start + start, self.start + stop)


def search_board(image: LineImage, board: Board, pitch_mm: float) -> DetectedCorners | None:
    """Find a board in an image whose pixels are squares of ``pitch_mm``, and locate its inner corners.

    A short image is searched as a whole. In a long one a board is looked for where a coarse copy shows its lattice, and
    the part with most of its corners counts; squares of a few pixels are not found there.

    Returns:
        As ``detect_board``.
    """
    length = math.ceil(_REACH * math.hypot(board.columns, board.rows) * board.square_mm / pitch_mm)
    if image.shape[0] <= _SHORT * length:
        return detect_board(image, board)
    if board.square_mm < _FEWEST_PX * pitch_mm:
        return None
    best, most = None, 0
    for part in _likely_parts(image, board, length, max(1, int(board.square_mm / pitch_mm / _SQUARE_PX))):
        found = detect_board(part, board)
        seen = 0 if found is None else int(found.valid.sum())
        if found is not None and seen > most:
            offset = found.position.new_tensor([0.0, part.start])
            best, most = replace(found, position=found.position + offset), seen
        if most == len(board.corner_points()):
            break
    return best


def _likely_parts(image: LineImage, board: Board, length: int, factor: int) -> Iterator[ImagePart]:
    """Parts whose reduced copy shows a board's lattice; they overlap by a board's length, so that one holds it all."""
    overlap = -(-length // factor)
    step = (_SHORT - 1) * overlap * factor
    before = torch.empty(0, image.shape[1] // factor)
    for start in range(0, image.shape[0], step):
        stop = min(start + step, image.shape[0])
        reduced = torch.cat([before, _reduced(image, start, stop, factor)])
        if _shows_lattice(reduced, board.inner):
            yield ImagePart(image, start - len(before) * factor, stop)
        before = reduced[-overlap:]


def _shows_lattice(brightness: Float[Tensor, "lines width"], inner: tuple[int, int]) -> bool:
    """Whether saddles are linked to a good part of a board's squares; those of texture hardly ever are."""
    if min(brightness.shape) < 2 * max(inner):
        return False
    corners, squares = inner[0] * inner[1], (inner[0] - 1) * (inner[1] - 1)
    saddles = find_saddle_points(brightness, 4 * corners, corners // 2)
    lattices = (grow_lattice(saddles, seed) for seed in range(min(_SEEDS, len(saddles.points))))
    return any(lattice is not None and _squares(lattice) >= _SEEN_SHARE * squares for lattice in lattices)


def _squares(lattice: Lattice) -> int:
    """Squares of a lattice with a saddle in each of their four corners."""
    node = lattice.node[lattice.on_grid].long()
    node = node - node.amin(0)
    seen = torch.zeros((node.amax(0) + 1).tolist(), dtype=torch.bool)
    seen[node[:, 0], node[:, 1]] = True
    return int((seen[1:, 1:] & seen[1:, :-1] & seen[:-1, 1:] & seen[:-1, :-1]).sum())


def _reduced(image: LineImage, start: int, stop: int, factor: int) -> Tensor:
    """Brightness of some lines, reduced; read in blocks that are large beside an image's chunks."""
    step = max(factor, _READ_LINES - _READ_LINES % factor)
    blocks = [TensorImage(image.read(line, min(line + step, stop))) for line in range(start, stop, step)]
    return torch.cat([reduce_image(block, factor) for block in blocks])
