"""Endless random textures: value noise on hashed integer lattices.

A texture is a function of integer nodes and a seed, so any part of it can be evaluated alone. Between the nodes it is
interpolated bilinearly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

# Extra nodes on every side of the samples, so that rounding never reaches beyond the lattice.
_BORDER = 2


@dataclass(frozen=True)
class Octave:
    """One layer of noise: the size of its cells, in nodes along x and y, and its weight."""

    cell_x: int
    cell_y: int
    weight: float = 1.0


@dataclass(frozen=True)
class Nodes:
    """A rectangle of lattice nodes: first index and count along x and y; node i lies at ``i * spacing_mm``."""

    first_x: int
    first_y: int
    count_x: int
    count_y: int
    spacing_mm: float

    def grid(self) -> tuple[Tensor, Tensor]:
        """Positions x ``(1, count_x)`` and y ``(count_y, 1)`` of the nodes, mm, float64."""
        x = torch.arange(self.first_x, self.first_x + self.count_x, dtype=torch.float64)[None]
        y = torch.arange(self.first_y, self.first_y + self.count_y, dtype=torch.float64)[:, None]
        return x * self.spacing_mm, y * self.spacing_mm


@dataclass(frozen=True)
class Raster:
    """Lattice values ``(channels, count_y, count_x)``, float32, and the nodes they belong to."""

    values: Tensor
    nodes: Nodes

    def at(self, x: Tensor, y: Tensor, base_y: int = 0) -> Tensor:
        """Bilinear values ``(channels, h, w)`` at points (x, y) mm; beyond the raster, those of its edge.

        ``y`` counts from node ``base_y``, which keeps float32 exact far along an endless texture.
        """
        nodes = self.nodes
        grid = torch.empty(*x.shape, 2)
        _normalise(x, nodes.first_x, nodes.count_x, nodes.spacing_mm, grid[..., 0])
        _normalise(y, nodes.first_y - base_y, nodes.count_y, nodes.spacing_mm, grid[..., 1])
        return grid_sample(self.values[None], grid[None], align_corners=True, padding_mode="border")[0]


def octaves(count: int, persistence: float = 0.85) -> tuple[Octave, ...]:
    """Isotropic octaves with cells of 1, 2, 4... nodes; each has ``persistence`` times the weight of the next finer."""
    return tuple(Octave(2**k, 2**k, persistence**k) for k in range(count))


def covering(x: Tensor, y: Tensor, spacing_mm: float, base_y: int = 0) -> Nodes:
    """Nodes that cover points (x, y) mm, where y counts from node ``base_y``."""
    (left, right), (top, bottom) = (
        ((float(low) / spacing_mm), (float(high) / spacing_mm)) for low, high in (x.aminmax(), y.aminmax())
    )
    first_x, first_y = int(left // 1) - _BORDER, int(top // 1) - _BORDER
    count_x, count_y = int(right // 1) + 2 + _BORDER - first_x, int(bottom // 1) + 2 + _BORDER - first_y
    return Nodes(first_x, first_y + base_y, count_x, count_y, spacing_mm)


def lattice_hash(x: Tensor, y: Tensor | int, seed: int) -> Tensor:
    """Uniform pseudo-random values in [-1, 1), float32, of integer nodes (int64).

    Counted in int32, which wraps as uint32 does and takes a quarter of int64's time; what its right shifts copy of the
    sign is masked away.

    Source: the 32-bit finaliser of MurmurHash3, Appleby 2011, over a linear mix of the coordinates.
    """
    h = x.to(torch.int32) * _wrapped(0x27D4EB2D) + _wrapped((seed + 1) * 0x9E3779B1)
    h = h + (_wrapped(y * 0x165667B1) if isinstance(y, int) else y.to(torch.int32) * _wrapped(0x165667B1))
    h ^= (h >> 15) & 0x1FFFF
    h *= _wrapped(0x85EBCA6B)
    h ^= (h >> 13) & 0x7FFFF
    h *= _wrapped(0xC2B2AE35)
    h ^= (h >> 16) & 0xFFFF
    h ^= -(2**31)  # less 2**31 as int32
    return h.float().mul_(2.0**-31)


def _wrapped(value: int) -> int:
    """The int32 of the same last 32 bits."""
    return (value + 2**31) % 2**32 - 2**31


def value_noise(nodes: Nodes, layers: Sequence[Octave], seed: int) -> Tensor:
    """Sum of octaves at lattice nodes, float32 ``(count_y, count_x)``, of zero mean and near unit variance."""
    total = torch.zeros(nodes.count_y, nodes.count_x)  # cells of one node have no place between
    for index, layer in enumerate(layers):
        cell_x, blend_x = _cells(nodes.first_x, nodes.count_x, layer.cell_x)
        cell_y, blend_y = _cells(nodes.first_y, nodes.count_y, layer.cell_y)
        coarse_x = torch.arange(int(cell_x[0]), int(cell_x[-1]) + 2)
        coarse_y = torch.arange(int(cell_y[0]), int(cell_y[-1]) + 2)
        values = lattice_hash(coarse_x[None], coarse_y[:, None], seed * 131 + index)
        if layer.cell_x > 1:
            at = cell_x - cell_x[0]
            values = torch.lerp(values.index_select(1, at), values.index_select(1, at + 1), blend_x[None])
        if layer.cell_y > 1:
            at = cell_y - cell_y[0]
            values = torch.lerp(values.index_select(0, at), values.index_select(0, at + 1), blend_y[:, None])
        total += values[: nodes.count_y, : nodes.count_x].mul_(layer.weight)
    # A uniform value in [-1, 1) has variance 1/3.
    return total * (3.0 / sum(layer.weight**2 for layer in layers)) ** 0.5


def _cells(first: int, count: int, size: int) -> tuple[Tensor, Tensor]:
    """Cell index of each node and its smooth position within the cell, 0..1."""
    node = torch.arange(first, first + count)
    cell = node.div(size, rounding_mode="floor")
    inside = (node - cell * size).float() / size
    return cell, inside * inside * (3.0 - 2.0 * inside)


def _normalise(position: Tensor, first: int, count: int, spacing_mm: float, out: Tensor) -> None:
    scale = 2.0 / (spacing_mm * (count - 1))
    torch.mul(position, scale, out=out)
    out -= 2.0 * first / (count - 1) + 1.0
