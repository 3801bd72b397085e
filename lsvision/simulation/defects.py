"""Defects of a rolled surface: pits and scratches at random places, roll marks at every turn of a damaged roll.

A surface position is (s, l): mm around the profile from the crown, and mm along the rail.
"""

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.noise import Nodes, lattice_hash

_PIT, _SCRATCH, _MARK = range(3)
# Where defects may lie: the crown, up to the start of the 13 mm radius.
_CROWN_MM = 20.0
_SCRATCH_LENGTH_MM, _SCRATCH_WIDTH_MM, _SCRATCH_DEPTH_MM, _SCRATCH_SKEW = 45.0, 1.0, 0.25, 0.12
_PIT_RADIUS_MM, _PIT_DEPTH_MM = (2.0, 4.5), (0.4, 1.0)
_MARK_RADII_MM, _MARK_DEPTH_MM, _MARK_S_MM = (5.0, 9.0), 0.4, 9.0


def defects(scene: SceneConfig, nodes: Nodes, seed: int) -> tuple[Tensor, Tensor]:
    """Depth of the defects, mm into the rail, and their factor on the reflectance, at nodes of (s, l).

    Returns:
        Two float32 tensors ``(count_y, count_x)``: zero and one where the surface is sound.
    """
    s, along = nodes.grid()
    depth, factor = torch.zeros(nodes.count_y, nodes.count_x), torch.ones(nodes.count_y, nodes.count_x)
    if scene.defect_spacing_mm > 0:
        cell = _cells(along, scene.defect_spacing_mm, _SCRATCH_LENGTH_MM)
        start = cell.double() * scene.defect_spacing_mm
        for add in (_pits, _scratches):
            share, deep, gloss = add(s, along, start, cell, scene.defect_spacing_mm, seed)
            depth, factor = depth + (deep * share).sum(0), factor * (1.0 + gloss * share).prod(0)
    if scene.roll_mark_period_mm > 0:
        cell = _cells(along, scene.roll_mark_period_mm, _MARK_RADII_MM[1])
        share = _bowl(
            (s - _MARK_S_MM) / _MARK_RADII_MM[0], (along - cell * scene.roll_mark_period_mm) / _MARK_RADII_MM[1]
        )
        depth, factor = depth + _MARK_DEPTH_MM * share.sum(0), factor * (1.0 - 0.55 * share).prod(0)
    return depth.float(), factor.float()


def _pits(
    s: Tensor, along: Tensor, start: Tensor, cell: Tensor, spacing: float, seed: int
) -> tuple[Tensor, Tensor, float]:
    across, place, size, deep = (_draw(cell, 4 * _PIT + k, seed) for k in range(4))
    radius = _PIT_RADIUS_MM[0] + size * (_PIT_RADIUS_MM[1] - _PIT_RADIUS_MM[0])
    share = _bowl((s - _CROWN_MM * (2 * across - 1)) / radius, (along - start - place * spacing) / radius)
    return share, _PIT_DEPTH_MM[0] + deep * (_PIT_DEPTH_MM[1] - _PIT_DEPTH_MM[0]), -0.65


def _scratches(
    s: Tensor, along: Tensor, start: Tensor, cell: Tensor, spacing: float, seed: int
) -> tuple[Tensor, Tensor, float]:
    across, place, skew = (_draw(cell, 4 * _SCRATCH + k, seed) for k in range(3))
    run = along - start - place * spacing
    aside = s - _CROWN_MM * (2 * across - 1) - _SCRATCH_SKEW * (2 * skew - 1) * run
    share = _bowl(aside / _SCRATCH_WIDTH_MM, (run / _SCRATCH_LENGTH_MM - 0.5) * 2.0)
    return share, place.new_tensor(_SCRATCH_DEPTH_MM), 1.2


def _bowl(a: Tensor, b: Tensor) -> Tensor:
    """Smooth hollow, 1 in the middle and 0 from the ellipse a² + b² = 1 outwards."""
    return (1.0 - a * a - b * b).clamp(min=0.0) ** 2


def _cells(along: Tensor, spacing: float, reach: float) -> Tensor:
    """Cells ``(cells, 1, 1)`` whose defects can touch the nodes."""
    first = int((float(along.min()) - reach) // spacing) - 1
    last = int((float(along.max()) + reach) // spacing) + 1
    return torch.arange(first, last + 1)[:, None, None]


def _draw(cell: Tensor, stream: int, seed: int) -> Tensor:
    """Uniform value 0..1 of each cell, float64."""
    return (lattice_hash(cell, stream, seed).double() + 1.0) / 2
