"""A pair of raw line cameras: where they see a moving object, and where on it their rays meet.

A column u of a camera has t = (u - c) / f; its ray leaves at the angle atan(t (1 + k1 t² + k2 t⁴)) + turn from Z, so
that it has the slope dx/dz of that angle's tangent. The left camera sees what crosses the plane Y = 0, the right one
what crosses Y = s0 + s1 (x - B/2) + s2 (z - z0). A point of the object at P on line 0 is at P - y n after the travel y.

Source: the distortion of Brown 1971, along the one axis of a line; the motion of Wang et al. 2024, Eq. 10-11.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.types import RawCamera, RawRig, ViewPlane

_OPTICS = 5  # quantities of a camera
_INVERSIONS = 5  # Newton steps of the distortion's inverse: from 0.1 of distortion on, rounding is left


def quantities_of(rig: RawRig) -> Float[Tensor, " quantities"]:
    """The quantities of a rig in the order and units of ``RIG_QUANTITIES``, float64."""
    cameras, view = (rig.left, rig.right), rig.view_plane
    values = [rig.baseline_mm, view.offset_mm, view.slope_x, view.slope_z]
    for camera in reversed(cameras):
        optics = (camera.focal_length_mm, camera.principal_px, math.degrees(camera.turn_rad), *camera.distortion)
        values = [*optics, *values]
    return torch.tensor(values, dtype=torch.float64)


def with_quantities(rig: RawRig, quantities: Float[Tensor, " quantities"]) -> RawRig:
    """The rig with other quantities; its view plane then counts depth from its own z0."""
    left, right, (baseline, s0, s1, s2) = quantities.split([_OPTICS, _OPTICS, 4])
    own = replace(
        rig,
        baseline_mm=float(baseline),
        left=_raw_camera(*left.tolist()),
        right=_raw_camera(*right.tolist()),
        view_plane=ViewPlane(float(s0), float(s1), float(s2)),
    )
    moved = float(s2 * (RawPair.of(own).z0_mm - RawPair.of(rig).z0_mm))
    return replace(own, view_plane=replace(own.view_plane, offset_mm=float(s0) + moved))


def _raw_camera(focal_length_mm: float, principal_px: float, turn_deg: float, k1: float, k2: float) -> RawCamera:
    return RawCamera(focal_length_mm, principal_px, math.radians(turn_deg), (k1, k2))


@dataclass(frozen=True)
class LineCamera:
    """The optics of one or many line cameras as tensors: f and c in px, the turn in rad, k1 and k2."""

    focal_px: Float[Tensor, "*batch"]
    principal_px: Float[Tensor, "*batch"]
    turn: Float[Tensor, "*batch"]
    k1: Float[Tensor, "*batch"]
    k2: Float[Tensor, "*batch"]

    def slope(self, column: Float[Tensor, "*columns"]) -> Float[Tensor, "*columns"]:
        """Slope dx/dz of the ray of a column, px."""
        t = (column - self.principal_px) / self.focal_px
        return _turned(self._distorted(t), torch.tan(self.turn))

    def column(self, slope: Float[Tensor, "*columns"]) -> Float[Tensor, "*columns"]:
        """Column, px, that looks along a slope dx/dz: the inverse of ``slope``, by Newton's method.

        The last step alone is differentiated: at the root it has the first derivatives of the inverse, and derivatives
        by twenty unknowns cost half the time.
        """
        distorted = _turned(slope, -torch.tan(self.turn))
        still = LineCamera(*(getattr(self, item.name).detach() for item in fields(self)))
        t = there = distorted.detach()
        for _ in range(_INVERSIONS - 1):
            t = still._nearer(t, there)
        return self._nearer(t, distorted) * self.focal_px + self.principal_px

    def _nearer(self, t: Tensor, distorted: Tensor) -> Tensor:
        """A Newton step of the distortion's inverse."""
        square = t.square()
        growth = 1 + square * (3 * self.k1 + 5 * self.k2 * square)
        return t - (self._distorted(t) - distorted) / growth

    def _distorted(self, t: Tensor) -> Tensor:
        square = t.square()
        return t * (1 + square * (self.k1 + self.k2 * square))


def _turned(slope: Tensor, tangent: Tensor) -> Tensor:
    """Tangent of the sum of two angles from their tangents."""
    return (slope + tangent) / (1 - slope * tangent)


@dataclass(frozen=True)
class Seen:
    """Where a camera sees a point: the column, px, and the nominal travel of the line, mm."""

    column: Float[Tensor, "*batch"]
    travel: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Met:
    """Where the rays of two columns meet: x and z at the left camera's line, mm, and how much later the right one is.

    ``later_mm`` is the nominal travel from the left camera's line to the right one's.
    """

    x: Float[Tensor, "*batch"]
    z: Float[Tensor, "*batch"]
    later_mm: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class RawPair:
    """Two line cameras as tensors; ``plane`` is (s0, s1, s2) of the right one, ``z0_mm`` where it counts depth from."""

    left: LineCamera
    right: LineCamera
    baseline_mm: Float[Tensor, "*batch"]
    plane: Float[Tensor, "*batch 3"]
    z0_mm: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, rig: RawRig, quantities: Float[Tensor, "*batch quantities"] | None = None) -> "RawPair":
        """Those of a rig, float64, or of rigs with other quantities, in the order of ``RIG_QUANTITIES``.

        The planes of all count depth from that of the rig itself.
        """
        values = quantities_of(rig) if quantities is None else quantities
        left, right, (baseline, *plane) = (part.unbind(-1) for part in values.split([_OPTICS, _OPTICS, 4], dim=-1))
        to_px = 1.0 / (rig.pixel_pitch_um * 1e-3)
        left, right = (LineCamera(f * to_px, c, turn.deg2rad(), k1, k2) for f, c, turn, k1, k2 in (left, right))
        own = cls(left, right, baseline, torch.stack(plane, dim=-1), baseline)
        z0 = own.crossing_mm((rig.width_px - 1) / 2) if quantities is None else RawPair.of(rig).z0_mm
        return replace(own, z0_mm=z0.expand_as(baseline))

    def crossing_mm(self, column: float) -> Float[Tensor, "*batch"]:
        """Depth z, mm, where the same column of both cameras looks at the same point."""
        at = torch.full_like(self.baseline_mm, column)
        return self.baseline_mm / (self.left.slope(at) - self.right.slope(at))

    def right_plane(self, x: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
        """Y, mm, of the plane that the right camera looks at."""
        s0, s1, s2 = self.plane.unbind(-1)
        return s0 + s1 * (x - self.baseline_mm / 2) + s2 * (z - self.z0_mm)

    def field_mm(self, width_px: int) -> Float[Tensor, "*batch"]:
        """What the left camera sees at z0 with lines of a width, mm."""
        first, last = (self.left.slope(torch.full_like(self.z0_mm, column)) for column in (0.0, width_px - 1.0))
        return (last - first) * self.z0_mm

    @property
    def middle(self) -> Float[Tensor, "*batch 3"]:
        """The point (B/2, 0, z0), mm, midway between the cameras."""
        return torch.stack([self.baseline_mm / 2, torch.zeros_like(self.z0_mm), self.z0_mm], dim=-1)

    def seen_left(self, points: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Seen:
        """Where the left camera sees points P, mm, of an object with the motion n."""
        travel = points[..., 1] / n[..., 1]
        x, _, z = (points - travel[..., None] * n).unbind(-1)
        return Seen(self.left.column(x / z), travel)

    def seen_right(self, points: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Seen:
        """Where the right camera sees points P, mm, of an object with the motion n."""
        s0, s1, s2 = self.plane.unbind(-1)
        from_middle = points[..., 0] - self.baseline_mm / 2
        ahead = points[..., 1] - s0 - s1 * from_middle - s2 * (points[..., 2] - self.z0_mm)
        travel = ahead / (n[..., 1] - s1 * n[..., 0] - s2 * n[..., 2])
        x, _, z = (points - travel[..., None] * n).unbind(-1)
        return Seen(self.right.column((x - self.baseline_mm) / z), travel)

    def meet(
        self, left_px: Float[Tensor, "*#batch"], right_px: Float[Tensor, "*#batch"], n: Float[Tensor, "*#batch 3"]
    ) -> Met:
        """Where on an object of motion n the rays of a left and a right column meet."""
        return self.meet_rays(self.left.slope(left_px), self.right.slope(right_px), n)

    def meet_rays(
        self, of_left: Float[Tensor, "*#batch"], of_right: Float[Tensor, "*#batch"], n: Float[Tensor, "*#batch 3"]
    ) -> Met:
        """Where on an object of motion n rays of the left and the right camera meet, by their slopes dx/dz.

        With Δ the travel between them, (z s_L, 0, z) = (B + z' s_R, s0 + .., z') + Δ n; all three are linear in z', the
        right camera's depth, and Δ.
        """
        s0, s1, s2 = self.plane.unbind(-1)
        drift_x, drift_z = n[..., 0] / n[..., 1], n[..., 2] / n[..., 1]
        # Of the right camera's plane along its ray: Y = constant + by_depth z'.
        constant, by_depth = s0 + s1 * self.baseline_mm / 2 - s2 * self.z0_mm, s1 * of_right + s2
        lever = of_left * drift_z - drift_x
        z_right = (self.baseline_mm + constant * lever) / (of_left - of_right - by_depth * lever)
        later = -(constant + by_depth * z_right) / n[..., 1]
        z = z_right + later * n[..., 2]
        return Met(of_left * z, z, later)
