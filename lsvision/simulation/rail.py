"""A rail swept along the motion: profile, mill scale and defects, seen by rays in the plane of its profile.

The rail does not change along its length but for its defects, so what a ray meets first is found in the plane across
it; the defects, a few tenths of a millimetre deep, then move the point along its ray.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.simulation.config import SceneConfig
from lsvision.simulation.defects import defects
from lsvision.simulation.lighting import Lighting
from lsvision.simulation.noise import Nodes, Octave, Raster, covering, octaves, value_noise
from lsvision.simulation.rail_profile import Hit, first_hit, head_60e1, slopes_from
from lsvision.simulation.surfaces import Conveyor, Look, tinted
from lsvision.simulation.trajectory import Rays
from lsvision.types import Pose

_TINT = (0.47, 0.44, 0.41)
# Mill scale is isotropic; rolling draws streaks along the rail. Cells in nodes, (around, along).
_SCALE = octaves(6)
_STREAKS = (Octave(1, 48, 0.8), Octave(3, 160, 1.0), Octave(12, 700, 1.2))
_RELIEF_STEPS = 2
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
        origin, across, ahead = rays.within(self.pose.rotation, self.pose.translation)
        slopes, horizon = slopes_from(chain, origin[:, 0], origin[:, 2])
        ray = _affine(rays.slope, across[:, 0], ahead[:, 0]) / _affine(rays.slope, across[:, 2], ahead[:, 2])
        seen = ((ray > horizon[:, :1]) & (ray < horizon[:, -1:])).any(0).nonzero()
        if not len(seen):
            return look
        columns = slice(int(seen[0]), int(seen[-1]) + 1)
        slope = rays.slope[columns]
        hit = first_hit(chain, slopes, horizon, origin[:, 2], ray[:, columns])
        view = (_affine(slope, across[:, axis], ahead[:, axis]) for axis in range(3))
        rail = self._surface(hit, origin, tuple(view), slope + rays.middle_slope, rays.camera_x_mm)  # type: ignore[arg-type]
        look.color[..., columns] = torch.where(hit.valid, rail.color, look.color[..., columns])
        look.z[:, columns] = torch.where(hit.valid, rail.z, look.z[:, columns])
        return look

    def _surface(
        self, hit: Hit, origin: Tensor, view: tuple[Tensor, Tensor, Tensor], slope: Tensor, camera_x_mm: float
    ) -> Look:
        """Colour and depth at hits; ``view`` is the direction of each ray in the rail's frame, per mm of depth."""
        spacing = self.config.texture_mm
        base = round(float(origin[len(origin) // 2, 1]) / spacing)
        z = (hit.z - origin[:, 2:].float()) / view[2]
        along = (origin[:, 1:2] - base * spacing).float() + z * view[1]
        normal_x, normal_z = torch.sin(hit.angle), -torch.cos(hit.angle)
        raster = self._bake(covering(hit.s, along, spacing, base))
        s, deeper = hit.s, torch.zeros_like(z)
        if bool(raster.values[1].any()):
            tangential = view[2] * normal_x - view[0] * normal_z
            inwards = -(view[0] * normal_x + view[2] * normal_z)
            inwards.clamp_(min=_LEAST_COSINE)
            for _ in range(_RELIEF_STEPS):
                deeper = raster.at(s, along + deeper * view[1], base)[1] / inwards
                s = hit.s + deeper * tangential
        albedo, _, fall = raster.at(s, along + deeper * view[1], base)
        z = z + deeper
        # A surface that falls inwards along s turns its normal by that slope towards +s.
        length = torch.rsqrt(1.0 + fall * fall)
        lit_x, lit_z = (normal_x - fall * normal_z) * length, (normal_z + fall * normal_x) * length
        albedo = albedo * self.lighting.irradiance(camera_x_mm + slope * z, z, lit_x, lit_z)
        return Look(tinted(albedo[None], _TINT), z)

    def _bake(self, nodes: Nodes) -> Raster:
        """Reflectance, depth of the defects (mm) and its derivative along s, at nodes of (s, l)."""
        seed = 8 * self.config.seed
        grain = value_noise(nodes, _SCALE, seed + 6) + value_noise(nodes, _STREAKS, seed + 7)
        depth, factor = defects(self.config, nodes, self.config.seed)
        fall = torch.gradient(depth, spacing=nodes.spacing_mm, dim=1)[0]
        albedo = (1.0 + self.config.rail_texture * grain).clamp_(0.3, 2.0) * factor
        return Raster(torch.stack([albedo, depth, fall]), nodes)


def _affine(slope: Tensor, across: Tensor, ahead: Tensor) -> Tensor:
    """Component ``k across + ahead`` of rays ``(h, w)``, float32."""
    return torch.addcmul(ahead.float()[:, None], across.float()[:, None], slope[None])
