"""Line lights above the object: beside the cameras and parallel to the motion, or along the sensor line.

Both are symmetric about the middle of the field, ``_ABOVE_MM`` above the plane of zero disparity. The brightness of a
matt surface is 1 midway on that plane.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from lsvision.geometry import middle_point
from lsvision.simulation.config import Lights
from lsvision.types import Rig

_ABOVE_MM = 400.0
_ASIDE_MM = 150.0  # along X, of a light that is parallel to the motion
# Of a light along the sensor line: along Y to either side, and half of its length.
_BEFORE_MM, _HALF_LENGTH_MM = 60.0, 350.0


@dataclass(frozen=True)
class Facet:
    """Places (x, z) of the scan plane, mm, with the components of their unit normal; normal_z < 0 faces the cameras."""

    x: Tensor
    z: Tensor
    normal_x: Tensor | float
    normal_z: Tensor | float


class Lighting(Protocol):
    """Lights above the scan plane."""

    def irradiance(self, x: Tensor, z: Tensor, normal_x: Tensor | float, normal_z: Tensor | float) -> Tensor:
        """Brightness of a matt surface at (x, z) mm of the scan plane with a unit normal."""
        ...

    def highlight(self, facet: Facet, eye_x_mm: float, sharpness: float) -> Tensor:
        """Brightness of the lights' reflections for a camera at (eye_x_mm, 0, 0), 1 at most for each light."""
        ...


@dataclass(frozen=True)
class LightsBeside:
    """Two line lights parallel to the motion, which the scan plane meets at points."""

    left_x_mm: float
    right_x_mm: float
    z_mm: float

    def irradiance(self, x: Tensor, z: Tensor, normal_x: Tensor | float, normal_z: Tensor | float) -> Tensor:
        """Brightness of a matt surface.

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

    def highlight(self, facet: Facet, eye_x_mm: float, sharpness: float) -> Tensor:
        """Reflections of both lights, after Blinn."""
        up = self.z_mm - facet.z
        left, right = (
            _blinn(facet, _Direction(light_x - facet.x, torch.zeros_like(up), up), eye_x_mm, sharpness)
            for light_x in (self.left_x_mm, self.right_x_mm)
        )
        return left + right


@dataclass(frozen=True)
class LightsAlong:
    """Two line lights along the sensor line, before and behind the scan plane, from ``first_x_mm`` to ``last_x_mm``."""

    first_x_mm: float
    last_x_mm: float
    z_mm: float

    def irradiance(self, x: Tensor, z: Tensor, normal_x: Tensor | float, normal_z: Tensor | float) -> Tensor:
        """Brightness of a matt surface: the integral of ``N·(L - P) / r³`` over the length of a light."""
        up = self.z_mm - z
        off = up.square() + _BEFORE_MM**2  # from the light's line, squared
        near, far = ((end - x) for end in (self.first_x_mm, self.last_x_mm))
        to_near, to_far = ((part.square() + off).rsqrt() for part in (near, far))
        across = (far * to_far - near * to_near) * up / off * normal_z
        along = (to_near - to_far) * normal_x
        reach = math.hypot(_HALF_LENGTH_MM, _BEFORE_MM, _ABOVE_MM)
        full = 2.0 * _HALF_LENGTH_MM / reach * _ABOVE_MM / (_ABOVE_MM**2 + _BEFORE_MM**2)
        return (across + along).clamp_(min=0.0).mul_(1.0 / full)

    def highlight(self, facet: Facet, eye_x_mm: float, sharpness: float) -> Tensor:
        """Reflections of both lights, after Blinn: that of the point of each light that is nearest to the mirrored ray.

        Both are alike, as the surface does not lean along Y.
        """
        up = self.z_mm - facet.z
        view_x, view_z = eye_x_mm - facet.x, -facet.z
        towards = 2 * (view_x * facet.normal_x + view_z * facet.normal_z)
        mirrored_x, mirrored_z = towards * facet.normal_x - view_x, towards * facet.normal_z - view_z
        rise = (mirrored_z / up).clamp(min=1e-3)  # both point up to the cameras
        aside = (facet.x + mirrored_x / rise).clamp(self.first_x_mm, self.last_x_mm) - facet.x
        to_light = _Direction(aside, torch.full_like(up, _BEFORE_MM), up)
        return 2.0 * _blinn(facet, to_light, eye_x_mm, sharpness)


def line_lights(rig: Rig, lights: Lights = "beside") -> Lighting:
    """The lights above a rig's plane of zero disparity."""
    middle_x, _, z0 = middle_point(rig).tolist()
    if lights == "along":
        return LightsAlong(middle_x - _HALF_LENGTH_MM, middle_x + _HALF_LENGTH_MM, z0 - _ABOVE_MM)
    return LightsBeside(middle_x - _ASIDE_MM, middle_x + _ASIDE_MM, z0 - _ABOVE_MM)


def _facing(aside: Tensor, up_part: Tensor, up_squared: Tensor, normal_x: Tensor | float) -> Tensor:
    towards = up_part + aside * normal_x
    return towards.clamp_(min=0.0).div_(torch.addcmul(up_squared, aside, aside))


@dataclass(frozen=True)
class _Direction:
    """A direction, of any length until it is ``unit``."""

    x: Tensor
    y: Tensor
    z: Tensor

    @property
    def unit(self) -> "_Direction":
        """The same of length 1."""
        scale = (self.x * self.x + self.y * self.y + self.z * self.z).rsqrt()
        return _Direction(self.x * scale, self.y * scale, self.z * scale)


def _blinn(facet: Facet, to_light: _Direction, eye_x_mm: float, sharpness: float) -> Tensor:
    """Power of the cosine between the normal and the middle of the directions to light and eye.

    Source: Blinn 1977, Models of light reflection for computer synthesized pictures.
    """
    light = to_light.unit
    eye = _Direction(eye_x_mm - facet.x, torch.zeros_like(facet.x), -facet.z).unit
    half = _Direction(light.x + eye.x, light.y + eye.y, light.z + eye.z).unit
    return (half.x * facet.normal_x + half.z * facet.normal_z).clamp(min=0.0).pow(sharpness)
