"""A rail swept along the motion: profile, mill scale and defects, seen by rays in the plane of its profile.

But for its defects a rail is the same all along its length, so the point that a ray meets first is found in the plane
across it. The defects, a few tenths of a millimetre deep, then move that point along the ray. Corrugation lifts the
whole profile that a line sees.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.defects import defects
from lsvision.simulation.lighting import Facet, Lighting
from lsvision.simulation.noise import Nodes, Octave, Raster, covering, lattice_hash, octaves, value_noise
from lsvision.simulation.rail_profile import Hit, first_hit, head_60e1, slopes_from
from lsvision.simulation.surfaces import Conveyor, Look, tinted
from lsvision.simulation.trajectory import Rays
from lsvision.types import Pose

_TINT = (0.47, 0.44, 0.41)
# Mill scale is isotropic; rolling draws streaks along the rail. Cells in nodes, (around, along).
_SCALE = octaves(6)
_STREAKS = (Octave(1, 48, 0.8), Octave(3, 160, 1.0), Octave(12, 700, 1.2))
_DEPTH = 1  # channel of the baked surface: reflectance, depth, fall
_RELIEF_STEPS = 2
_CORRUGATION_STREAM = 11
# Defects lie on the crown, where rays fall nearly along the normal; the bound only keeps hidden flanks finite.
_LEAST_COSINE = 0.3


@dataclass(frozen=True)
class RailScene:
    """A rail over the conveyor; the frame's origin lies on the crown, Y along the rail, Z into it."""

    config: SceneConfig
    pose: Pose
    lighting: Lighting
    conveyor: Conveyor

    def look(self, rays: Rays) -> Look:
        """Colour and depth of the rail's head, and of the conveyor beside it."""
        look, chain = self.conveyor.look(rays), head_60e1()
        local = _lowered(rays.in_frame(self.pose), self.config)
        eye_z = local.origin[:, 2]
        slopes, horizon = slopes_from(chain, local.origin[:, 0], eye_z)
        ray = local.direction(0) / local.direction(2)
        seen = ((ray > horizon[:, :1]) & (ray < horizon[:, -1:])).any(0).nonzero()
        if not len(seen):
            return look
        columns = slice(int(seen[0]), int(seen[-1]) + 1)
        hit = first_hit(chain, slopes, horizon, eye_z, ray[:, columns])
        rail = self._surface(hit, local.on_columns(columns))
        look.color[..., columns] = torch.where(hit.valid, rail.color, look.color[..., columns])
        look.z[:, columns] = torch.where(hit.valid, rail.z, look.z[:, columns])
        return look

    def _surface(self, hit: Hit, rays: Rays) -> Look:
        """Colour and depth where rays, given in the rail's frame, hit its sound profile.

        A defect moves the point along its ray; depth and place on the surface follow by fixed-point steps.
        """
        ray_x, ray_y, ray_z = (rays.direction(axis) for axis in range(3))
        spacing = self.config.texture_mm
        base = round(float(rays.origin[len(rays.origin) // 2, 1]) / spacing)
        z = (hit.z - rays.origin[:, 2:].float()) / ray_z
        along = (rays.origin[:, 1:2] - base * spacing).float() + z * ray_y
        normal_x, normal_z = torch.sin(hit.angle), -torch.cos(hit.angle)
        raster = self._bake(covering(hit.s, along, spacing, base))
        s, deeper = hit.s, torch.zeros_like(z)
        if bool(raster.values[_DEPTH].any()):
            tangential = ray_z * normal_x - ray_x * normal_z
            inwards = -(ray_x * normal_x + ray_z * normal_z)
            inwards.clamp_(min=_LEAST_COSINE)
            for _ in range(_RELIEF_STEPS):
                deeper = raster.at(s, along + deeper * ray_y, base)[_DEPTH] / inwards
                s = hit.s + deeper * tangential
        albedo, _, fall = raster.at(s, along + deeper * ray_y, base)
        z = z + deeper
        # A surface that falls inwards along s turns its normal by that slope towards +s.
        length = torch.rsqrt(1.0 + fall * fall)
        lit_x, lit_z = (normal_x - fall * normal_z) * length, (normal_z + fall * normal_x) * length
        scan_x = rays.scan_x(z)
        color = tinted((albedo * self.lighting.irradiance(scan_x, z, lit_x, lit_z))[None], _TINT)
        if self.config.rail_gloss > 0:
            facet = Facet(scan_x, z, lit_x, lit_z)
            reflected = self.lighting.highlight(facet, rays.camera_x_mm, self.config.rail_sharpness)
            color += self.config.rail_gloss * albedo * reflected  # scale and streaks dull it
        return Look(color, z)

    def _bake(self, nodes: Nodes) -> Raster:
        """Reflectance, depth of the defects (mm) and its derivative along s, at nodes of (s, l)."""
        seed = 8 * self.config.seed
        grain = value_noise(nodes, _SCALE, seed + 6) + value_noise(nodes, _STREAKS, seed + 7)
        relief = defects(self.config, nodes, self.config.seed)
        fall = torch.gradient(relief.depth_mm, spacing=nodes.spacing_mm, dim=1)[0]
        albedo = (1.0 + self.config.rail_texture * grain).clamp_(0.3, 2.0) * relief.factor
        return Raster(torch.stack([albedo, relief.depth_mm, fall]), nodes)


def corrugation_mm(scene: SceneConfig, along_mm: Tensor) -> Tensor:
    """Height of a corrugated rail over its mean, mm, where the crown is ``along_mm`` from the frame's origin."""
    phase = math.pi * float(lattice_hash(torch.tensor(0), _CORRUGATION_STREAM, scene.seed))
    return scene.corrugation_mm * torch.sin(2.0 * math.pi / scene.corrugation_wavelength_mm * along_mm + phase)


def crown_place(rays: Rays) -> Tensor:
    """Place along the rail, mm, float64, at which each line sees the crown, from rays in the rail's frame."""
    (across_x, across_y, across_z), (ahead_x, ahead_y, ahead_z) = rays.across.unbind(-1), rays.ahead.unbind(-1)
    (x, y, z), turn = rays.origin.unbind(-1), across_x * ahead_z - across_z * ahead_x
    sideways, depth = (ahead_x * z - ahead_z * x) / turn, (across_z * x - across_x * z) / turn
    return y + sideways * across_y + depth * ahead_y


def _lowered(rays: Rays, scene: SceneConfig) -> Rays:
    """Rays in the rail's frame, as far below as the corrugation lifts the profile that their line sees."""
    if scene.corrugation_mm == 0:
        return rays
    lower = torch.zeros_like(rays.origin)
    lower[:, 2] = corrugation_mm(scene, crown_place(rays))
    return replace(rays, origin=rays.origin + lower)
