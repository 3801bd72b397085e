"""A checkerboard's grid from the saddles of an image: for boards partly hidden, cut off, or strongly sheared."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.board.saddle_points import SaddlePoints, find_saddle_points

_CANDIDATES = 4  # times the board's corners
_EXPECTED_SHARE = 0.5  # of the board's corners that are among the strongest saddles
_SEEDS = 8
_OPPOSITE = -0.5  # alignment of a neighbour along an edge
_ASIDE = 0.3  # sine of the angle between the two steps of a lattice
_RADII = (1.6, 2.6, 3.6, 5.0, 7.0, 10.0, 15.0, 25.0, 40.0)  # squares around the seed, from which the grid grows
_OFF_GRID = 0.25  # squares
_ALIGNED = 0.3
_CURVED = 24  # saddles that are enough for a quadratic map
_EVEN = (0.65, 1.5)  # of the median corner
_SEEN_SHARE = 0.5  # of the board's corners
_STRAY_SHARE = 0.1  # of the grid's saddles that may lie beyond the board


@dataclass(frozen=True)
class QuadraticMap:
    """Map of the plane by polynomials of the second degree: rows for 1, x, y, x², xy, y²."""

    coefficients: Float[Tensor, "6 2"]

    @classmethod
    def linear(cls, matrix: Float[Tensor, "2 2"]) -> "QuadraticMap":
        """``matrix @ position``."""
        return cls(torch.cat([matrix.new_zeros(1, 2), matrix.mT, matrix.new_zeros(3, 2)]))

    @classmethod
    def fitted(cls, position: Tensor, image: Tensor, terms: int = 6) -> "QuadraticMap":
        """Least squares on the first ``terms`` rows: 3 are an affine map."""
        coefficients = position.new_zeros(6, 2)
        coefficients[:terms] = torch.linalg.lstsq(cls._powers(position)[:, :terms], image).solution
        return cls(coefficients)

    def __call__(self, position: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Images of positions."""
        return self._powers(position) @ self.coefficients

    @staticmethod
    def _powers(position: Tensor) -> Tensor:
        x, y = position.unbind(-1)
        return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=-1)


@dataclass(frozen=True)
class Lattice:
    """Whole squares from a seed to each saddle, along the squares' edges, and which saddles lie on such nodes."""

    node: Float[Tensor, "saddles 2"]
    on_grid: Bool[Tensor, " saddles"]

    @property
    def count(self) -> int:
        """Saddles on the lattice."""
        return int(self.on_grid.sum())


@dataclass(frozen=True)
class Placement:
    """Column and row of each saddle on the board, and how many of the board's corners were seen."""

    node: Int[Tensor, "saddles 2"]
    seen: int

    def on_board(self, inner: tuple[int, int]) -> Bool[Tensor, " saddles"]:
        """Saddles that are corners of the board."""
        return ((self.node >= 0) & (self.node < self.node.new_tensor(inner))).all(-1)


def find_saddle_grid(
    brightness: Float[Tensor, "lines width"], inner: tuple[int, int]
) -> Float[Tensor, "rows columns 2"] | None:
    """Inner corners of a board of which at least half are seen, as (u, v) px; the others where the grid continues.

    Saddles are linked to a lattice: neighbours along the squares' edges have opposite curvatures, which no texture has.
    From a few seeds the lattice is fitted to ever wider surroundings. Where a part of the board is beyond the image,
    the grid may be shifted along the lattice by whole squares.

    Args:
        brightness: of an image in which squares have eight pixels or more.
        inner: corners along the longer side and along the shorter.
    """
    corners = inner[0] * inner[1]
    saddles = find_saddle_points(brightness, _CANDIDATES * corners, int(_EXPECTED_SHARE * corners))
    if len(saddles.points) < _SEEN_SHARE * corners:
        return None
    seeds = range(min(_SEEDS, len(saddles.points)))
    lattices = [lattice for seed in seeds if (lattice := grow_lattice(saddles, seed)) is not None]
    if not lattices:
        return None
    lattice = max(lattices, key=lambda lattice: lattice.count)
    # Where squares end at the board's rim three quadrants are white, which is half as even as a corner of four squares;
    # saddles of noise and of fine texture are more even than any.
    share = saddles.evenness / saddles.evenness[lattice.on_grid].median()
    corner = lattice.on_grid & (share > _EVEN[0]) & (share < _EVEN[1])
    return board_on_lattice(saddles.points[corner], lattice.node[corner], inner)


def grow_lattice(saddles: SaddlePoints, seed: int) -> Lattice | None:
    """The lattice around one saddle, fitted to the saddles of ever wider surroundings; None where there is none."""
    offset, alignment = saddles.points - saddles.points[seed], saddles.alignment(seed)
    steps = _first_steps(offset, alignment)
    if steps is None:
        return None
    scale = steps.norm()
    scaled = offset / scale
    to_node = QuadraticMap.linear(torch.linalg.inv(steps) * scale)
    for radius in _RADII:
        position = to_node(scaled)
        lattice = _nodes_within(position, alignment, radius)
        if lattice.count < 3:
            return None
        terms, used = 6 if lattice.count >= _CURVED else 3, lattice.on_grid
        to_node = QuadraticMap.fitted(scaled[used], lattice.node[used], terms)
    return lattice


def _first_steps(offset: Tensor, alignment: Tensor) -> Tensor | None:
    """Steps (2, 2), as columns, from the seed to the nearest neighbours along the two edges that cross in it."""
    neighbours = offset[alignment < _OPPOSITE]
    neighbours = neighbours[neighbours.norm(dim=-1).argsort()]
    if len(neighbours) < 2:
        return None
    first = neighbours[0]
    crossing = first[0] * neighbours[:, 1] - first[1] * neighbours[:, 0]
    aside = neighbours[crossing.abs() > _ASIDE * first.norm() * neighbours.norm(dim=-1)]
    return torch.stack([first, aside[0]], dim=-1) if len(aside) else None


def _nodes_within(position: Tensor, alignment: Tensor, radius: float) -> Lattice:
    """Nearest nodes of saddles at given positions, squares from the seed: on the grid are near ones of their colour."""
    node = position.round()
    even = node.sum(-1).remainder(2) == 0
    on_grid = ((position - node).abs() < _OFF_GRID).all(-1)
    on_grid &= torch.where(even, alignment, -alignment) > _ALIGNED
    return Lattice(node, on_grid & (position.abs() <= radius).all(-1))


def board_on_lattice(
    points: Float[Tensor, "saddles 2"], node: Float[Tensor, "saddles 2"], inner: tuple[int, int]
) -> Float[Tensor, "rows columns 2"] | None:
    """The board's grid where most of its corners lie on nodes with a saddle; None where they are too few."""
    node = (node - node.amin(0)).long()
    # The board's longer side may run along either axis of the lattice.
    placement = max((_best_placement(turned, inner) for turned in (node, node.flip(-1))), key=lambda place: place.seen)
    on_board = placement.on_board(inner)
    enough = placement.seen >= _SEEN_SHARE * inner[0] * inner[1]
    if not enough or int((~on_board).sum()) > _STRAY_SHARE * len(node):
        return None
    corner, seen = placement.node[on_board], points[on_board]
    y, x = torch.meshgrid(torch.arange(inner[1]), torch.arange(inner[0]), indexing="ij")
    grid = QuadraticMap.fitted(corner.double(), seen)(torch.stack([x, y], dim=-1).double())
    grid[corner[:, 1], corner[:, 0]] = seen
    return grid


def _best_placement(node: Tensor, inner: tuple[int, int]) -> Placement:
    """The board placed on nodes (saddles, 2), counted from 0, so that it covers as many as possible."""
    columns, rows = inner
    occupied = torch.zeros(int(node[:, 1].max()) + 1, int(node[:, 0].max()) + 1)
    occupied[node[:, 1], node[:, 0]] = 1
    padded = F.pad(occupied, (columns - 1, columns - 1, rows - 1, rows - 1))
    covered = F.avg_pool2d(padded[None], (rows, columns), 1)[0] * rows * columns
    row, column = divmod(int(covered.argmax()), covered.shape[1])
    first_corner = node.new_tensor([column - columns + 1, row - rows + 1])
    return Placement(node - first_corner, int(covered.max().round()))
