"""Two line lights beside the cameras, symmetric about the middle of the field and parallel to the motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import middle_point
from lsvision.types import Rig

# Distance of each light from the middle of the field along X, and above the plane of zero disparity.
_ASIDE_MM, _ABOVE_MM = 150.0, 400.0


@dataclass(frozen=True)
class Lighting:
    """Positions of the lights in the scan plane; the brightness is 1 midway on the plane of zero disparity."""

    left_x_mm: float
    right_x_mm: float
    z_mm: float

    def irradiance(self, x: Tensor, z: Tensor, normal_x: Tensor | float, normal_z: Tensor | float) -> Tensor:
        """Brightness of a matt surface at (x, z) mm of the scan plane.

        The light of a line falls off with its distance r and with the cosine of the angle of incidence:
        ``N·(L - P) / r²``.

        Args:
            x, z: position, mm.
            normal_x, normal_z: components of the unit normal; normal_z < 0 faces the cameras.
        """
        up = self.z_mm - z
        up_squared, up_part = up * up, up * normal_z
        left, right = (
            _facing(light_x - x, up_part, up_squared, normal_x) for light_x in (self.left_x_mm, self.right_x_mm)
        )
        full = 2.0 * _ABOVE_MM / (_ASIDE_MM**2 + _ABOVE_MM**2)
        return left.add_(right).mul_(1.0 / full)


def line_lights(rig: Rig) -> Lighting:
    """The lights above a rig's plane of zero disparity."""
    middle_x, _, z0 = middle_point(rig).tolist()
    return Lighting(middle_x - _ASIDE_MM, middle_x + _ASIDE_MM, z0 - _ABOVE_MM)


def _facing(aside: Tensor, up_part: Tensor, up_squared: Tensor, normal_x: Tensor | float) -> Tensor:
    towards = up_part + aside * normal_x
    return towards.clamp_(min=0.0).div_(torch.addcmul(up_squared, aside, aside))
