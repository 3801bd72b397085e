"""Defects of a rolled surface: pits and scratches at random places, roll marks at every turn of a damaged roll.

A surface position is (s, l): mm around the profile from the crown, and mm along the rail.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.noise import Nodes, lattice_hash

_PIT, _SCRATCH, _MARK = range(3)
# Defects lie on the crown, up to the start of the 13 mm radius.
_CROWN_MM = 20.0
SCRATCH_LENGTH_MM, _SCRATCH_WIDTH_MM, _SCRATCH_DEPTH_MM, _SCRATCH_SKEW = 45.0, 1.0, 0.25, 0.12
_MARK_RADII_MM, _MARK_DEPTH_MM, _MARK_S_MM = (5.0, 9.0), 0.4, 9.0
# Relative change of the reflectance in the middle of a defect: scratches show bright metal.
_PIT_GLOSS, _SCRATCH_GLOSS, _MARK_GLOSS = -0.65, 1.2, -0.55


@dataclass(frozen=True)
class Relief:
    """A surface at nodes of (s, l), ``(count_y, count_x)`` each.

    Attributes:
        depth_mm: depth of the defects, mm into the rail; 0 where the surface is sound.
        factor: factor on the reflectance; 1 where the surface is sound.
    """

    depth_mm: Tensor
    factor: Tensor


@dataclass(frozen=True)
class Cells:
    """Equal lengths of rail, ``spacing_mm`` each, with one defect of a kind at a random place in each.

    ``index`` is ``(cells, 1, 1)``, int64; cell i begins at ``i * spacing_mm`` along the rail.
    """

    index: Tensor
    spacing_mm: float

    def draw(self, stream: int, seed: int) -> Tensor:
        """Uniform value 0..1 of each cell, float64."""
        return (lattice_hash(self.index, stream, seed).double() + 1.0) / 2


@dataclass(frozen=True)
class Pits:
    """Round hollows: middle (s, along), radius and depth, mm, ``(pits, 1, 1)``."""

    s: Tensor
    along: Tensor
    radius_mm: Tensor
    depth_mm: Tensor


@dataclass(frozen=True)
class Scratches:
    """Long hollows that begin at (s, along), mm, and run aside by ``skew`` mm a mm; ``(scratches, 1, 1)``."""

    s: Tensor
    along: Tensor
    skew: Tensor


def defects(scene: SceneConfig, nodes: Nodes, seed: int) -> Relief:
    """Depth and reflectance, float32, of all defects of a rail at nodes of (s, l)."""
    s, along = nodes.grid()
    parts = []
    if scene.defect_spacing_mm > 0:
        cells = _cells_near(along, scene.defect_spacing_mm, SCRATCH_LENGTH_MM)
        parts += [_pits(s, along, drawn_pits(scene, cells, seed)), _scratches(s, along, drawn_scratches(cells, seed))]
    if scene.roll_mark_period_mm > 0:
        parts.append(_roll_marks(s, along, _cells_near(along, scene.roll_mark_period_mm, _MARK_RADII_MM[1])))
    depth, factor = torch.zeros(nodes.count_y, nodes.count_x), torch.ones(nodes.count_y, nodes.count_x)
    for part in parts:
        depth, factor = depth + part.depth_mm, factor * part.factor
    return Relief(depth.float(), factor.float())


def drawn_pits(scene: SceneConfig, cells: Cells, seed: int) -> Pits:
    """The pit of every cell."""
    across, place, size, deep = (cells.draw(4 * _PIT + k, seed) for k in range(4))
    (least, largest), (shallow, deepest) = scene.pit_radius_mm, scene.pit_depth_mm
    return Pits(
        _CROWN_MM * (2 * across - 1),
        cells.index.double() * cells.spacing_mm + place * cells.spacing_mm,
        least + size * (largest - least),
        shallow + deep * (deepest - shallow),
    )


def drawn_scratches(cells: Cells, seed: int) -> Scratches:
    """The scratch of every cell."""
    across, place, skew = (cells.draw(4 * _SCRATCH + k, seed) for k in range(3))
    return Scratches(
        _CROWN_MM * (2 * across - 1),
        cells.index.double() * cells.spacing_mm + place * cells.spacing_mm,
        _SCRATCH_SKEW * (2 * skew - 1),
    )


def _pits(s: Tensor, along: Tensor, pits: Pits) -> Relief:
    share = _bowl((s - pits.s) / pits.radius_mm, (along - pits.along) / pits.radius_mm)
    return Relief((pits.depth_mm * share).sum(0), (1.0 + _PIT_GLOSS * share).prod(0))


def _scratches(s: Tensor, along: Tensor, scratches: Scratches) -> Relief:
    run = along - scratches.along
    aside = s - scratches.s - scratches.skew * run
    share = _bowl(aside / _SCRATCH_WIDTH_MM, (run / SCRATCH_LENGTH_MM - 0.5) * 2.0)
    return Relief((_SCRATCH_DEPTH_MM * share).sum(0), (1.0 + _SCRATCH_GLOSS * share).prod(0))


def _roll_marks(s: Tensor, along: Tensor, cells: Cells) -> Relief:
    """The same mark at the start of every cell, one turn of the roll apart."""
    share = _bowl((s - _MARK_S_MM) / _MARK_RADII_MM[0], (along - cells.index * cells.spacing_mm) / _MARK_RADII_MM[1])
    return Relief(_MARK_DEPTH_MM * share.sum(0), (1.0 + _MARK_GLOSS * share).prod(0))


def _bowl(a: Tensor, b: Tensor) -> Tensor:
    """Smooth hollow, 1 in the middle and 0 from the ellipse a² + b² = 1 outwards."""
    return (1.0 - a * a - b * b).clamp(min=0.0) ** 2


def _cells_near(along: Tensor, spacing_mm: float, reach_mm: float) -> Cells:
    """Cells whose defects, ``reach_mm`` long at most, can touch the nodes."""
    first = int((float(along.min()) - reach_mm) // spacing_mm) - 1
    last = int((float(along.max()) + reach_mm) // spacing_mm) + 1
    return Cells(torch.arange(first, last + 1)[:, None, None], spacing_mm)
