"""The lattice of a checkerboard from the saddles of an image: of boards partly hidden, cut off, or sheared."""

from dataclasses import dataclass

import torch
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
_EVEN = (0.65, 1.5)  # of another corner; corners of photographs are within (0.8, 1.25) of their median


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
class SeenLattice:
    """Corners of chequered squares as an image shows them: (u, v) px, and whole squares from any one of them.

    Which way the two axes of the nodes run, and which corner of a board any of them is, is not known.
    """

    node: Int[Tensor, "corners 2"]
    position: Float[Tensor, "corners 2"]

    @classmethod
    def of_grid(cls, grid: Float[Tensor, "rows columns 2"]) -> "SeenLattice":
        """A whole grid, of which all corners were seen."""
        y, x = torch.meshgrid(torch.arange(grid.shape[0]), torch.arange(grid.shape[1]), indexing="ij")
        return cls(torch.stack([x, y], dim=-1).reshape(-1, 2), grid.reshape(-1, 2).double())

    def turned(self, axes: Int[Tensor, "2 2"], origin: Int[Tensor, "2"]) -> "SeenLattice":
        """The same corners counted along other axes: node ``axes @ node + origin``."""
        return SeenLattice(self.node @ axes.mT + origin, self.position)

    def enlarged(self, factor: int) -> "SeenLattice":
        """The same corners in the image of which this was a reduced copy."""
        return SeenLattice(self.node, (self.position + 0.5) * factor - 0.5)

    def steps(self) -> Float[Tensor, "2 2"]:
        """Mean steps from node to node along either axis, as columns, px."""
        return QuadraticMap.fitted(self.node.double(), self.position, 3).coefficients[1:3].mT

    def to_image(self) -> QuadraticMap:
        """Where the lattice continues: positions of nodes, by least squares."""
        return QuadraticMap.fitted(self.node.double(), self.position, 6 if len(self.node) >= _CURVED else 3)


def find_saddle_lattice(
    brightness: Float[Tensor, "lines width"], corners: int, hidden: Bool[Tensor, " lines"] | None = None
) -> SeenLattice | None:
    """The largest lattice of chequered squares in an image; None where there is none.

    Saddles are linked to a lattice: neighbours along the squares' edges have opposite curvatures, which no texture has.
    From a few seeds the lattice is fitted to ever wider surroundings.

    Args:
        brightness: of an image in which squares have eight pixels or more.
        corners: of the whole board.
        hidden: lines on which no saddle counts; the lattice ends where they hide a row of its corners.
    """
    saddles = find_saddle_points(brightness, _CANDIDATES * corners, int(_EXPECTED_SHARE * corners))
    if hidden is not None:
        saddles = saddles.of(~hidden[saddles.points[:, 1].long()])
    seeds = range(min(_SEEDS, len(saddles.points)))
    lattices = [lattice for seed in seeds if (lattice := grow_lattice(saddles, seed)) is not None]
    if not lattices:
        return None
    lattice = max(lattices, key=lambda lattice: lattice.count)
    corner = lattice.on_grid & _as_even(saddles, saddles.evenness[lattice.on_grid].median())
    node = lattice.node[corner].long()
    patch = patches(node)
    linked = patch == patch.mode().values if len(patch) else corner[corner]
    return SeenLattice(node[linked], saddles.points[corner][linked])


def patches(node: Int[Tensor, "corners 2"]) -> Int[Tensor, " corners"]:
    """A number for each node, the same for all that are linked by steps from a node to one of its four neighbours."""
    linked = (node[:, None] - node[None]).abs().sum(-1) <= 1
    patch = torch.arange(len(node))
    while len(node):
        smallest = torch.where(linked, patch, len(node)).amin(-1)
        if torch.equal(smallest, patch):
            break
        patch = smallest
    return patch


def _as_even(saddles: SaddlePoints, evenness: Tensor) -> Tensor:
    """Saddles that are about as even as one.

    Where squares end at the board's rim three quadrants are white, which is a third as even as a corner of four
    squares; saddles of noise and of fine texture are more even than any.
    """
    share = saddles.evenness / evenness
    return (share > _EVEN[0]) & (share < _EVEN[1])


def grow_lattice(saddles: SaddlePoints, seed: int) -> Lattice | None:
    """The lattice around one saddle, fitted to the saddles of ever wider surroundings; None where there is none."""
    offset = saddles.points - saddles.points[seed]
    alignment = saddles.alignment(seed)
    steps = _first_steps(offset, alignment)
    if steps is None:
        return None
    scale = steps.norm()
    scaled = offset / scale
    to_node = QuadraticMap.linear(torch.linalg.inv(steps) * scale)
    for radius in _RADII:
        position = to_node(scaled)
        lattice = _linked_to(seed, _nodes_within(position, alignment, radius))
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


def _linked_to(seed: int, lattice: Lattice) -> Lattice:
    """The lattice without saddles that happen to lie on it apart from the seed's patch, as those of a background do."""
    if not lattice.on_grid[seed]:
        return lattice
    patch = patches(lattice.node[lattice.on_grid].long())
    on_grid = lattice.on_grid.clone()
    on_grid[lattice.on_grid] = patch == patch[int(lattice.on_grid[:seed].sum())]
    return Lattice(lattice.node, on_grid)
