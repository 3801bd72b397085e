"""Radiometric references: a white plane that moves along, with dirt on it, and a scan without light."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.lighting import Lighting
from lsvision.simulation.noise import Nodes, Octave, Raster, covering, octaves, value_noise
from lsvision.simulation.plane import view_plane
from lsvision.simulation.surfaces import Look, light_on, tinted
from lsvision.simulation.trajectory import Rays
from lsvision.types import Pose

_WHITE = (0.82, 0.82, 0.82)
_GRAIN, _DIRT = 0.01, 0.45  # contrast of the surface, and what a speck takes of the light
_EDGE = 3.0  # steepness of a speck's edge
_SAMPLED = 512  # nodes along each axis, whose values show how high the share of the dirt reaches
_OCTAVES = octaves(3)


@dataclass(frozen=True)
class ReferenceScene:
    """The white reference, or the dark one, in the plane Z = 0 of a frame whose Y runs along the motion."""

    config: SceneConfig
    pose: Pose
    lighting: Lighting

    def look(self, rays: Rays) -> Look:
        """Colour and depth."""
        view = view_plane(rays, self.pose, self.config.texture_mm)
        if self.config.kind == "dark":
            return Look(view.z.new_zeros(3, *view.z.shape), view.z)
        nodes = covering(view.x, view.y, self.config.texture_mm, view.base_y)
        albedo = Raster(self._bake(nodes)[None], nodes).at(view.x, view.y, view.base_y)
        return Look(tinted(albedo.mul_(light_on(self.lighting, self.pose, view)), _WHITE), view.z)

    def _bake(self, nodes: Nodes) -> Tensor:
        """Reflectance at nodes, 1 of a clean white."""
        grain = value_noise(nodes, _OCTAVES, 8 * self.config.seed + 2).mul_(_GRAIN).add_(1.0)
        if self.config.dirt_share == 0:
            return grain
        specks = value_noise(nodes, (self._speck,), 8 * self.config.seed + 3)
        covered = specks.sub_(_level(self._speck, self.config.dirt_share)).mul_(_EDGE).add_(0.5).clamp_(0.0, 1.0)
        return grain.mul_(covered.mul_(-_DIRT).add_(1.0))

    @property
    def _speck(self) -> Octave:
        cell = max(1, round(self.config.dirt_mm / self.config.texture_mm))
        return Octave(cell, cell)


@lru_cache(maxsize=8)
def _level(speck: Octave, share: float) -> float:
    """What a share of the values of an octave exceeds."""
    values = value_noise(Nodes(0, 0, _SAMPLED, _SAMPLED, 1.0), (speck,), 0)
    return float(torch.quantile(values, 1.0 - share))
