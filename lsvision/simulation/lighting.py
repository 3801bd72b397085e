"""Two line lights beside the cameras, symmetric about the middle of the field and parallel to the motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.types import Rig

# Each light stands this far beside the middle of the field and this far before the plane of zero disparity.
_ASIDE_MM, _BEFORE_MM = 150.0, 400.0


@dataclass(frozen=True)
class Lighting:
    """Positions of the lights in the scan plane; brightness one midway on the plane of zero disparity."""

    left_x_mm: float
    right_x_mm: float
    z_mm: float

    def irradiance(self, x: Tensor, z: Tensor, normal_x: Tensor | float, normal_z: Tensor | float) -> Tensor:
        """Brightness of a matt surface at (x, z) mm of the scan plane.

        A line light weakens with its distance r and with the cosine of the angle of incidence: ``N·(L - P) / r²``.

        Args:
            normal_x, normal_z: parts of the unit normal in the scan plane; normal_z < 0 faces the cameras.
        """
        up = self.z_mm - z
        up_squared, up_part = up * up, up * normal_z
        left, right = (
            _facing(light_x - x, up_part, up_squared, normal_x) for light_x in (self.left_x_mm, self.right_x_mm)
        )
        full = 2.0 * _BEFORE_MM / (_ASIDE_MM**2 + _BEFORE_MM**2)
        return left.add_(right).mul_(1.0 / full)


def line_lights(rig: Rig) -> Lighting:
    """The lights of a rig."""
    middle = rig.baseline_mm / 2
    return Lighting(middle - _ASIDE_MM, middle + _ASIDE_MM, rig.zero_disparity_mm - _BEFORE_MM)


def _facing(aside: Tensor, up_part: Tensor, up_squared: Tensor, normal_x: Tensor | float) -> Tensor:
    towards = up_part + aside * normal_x
    return towards.clamp_(min=0.0).div_(torch.addcmul(up_squared, aside, aside))
