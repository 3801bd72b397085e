"""Projection and triangulation of a pair of line cameras.

A column u of the left camera looks along x/z = slope = (u - c_L) / f, with f the focal length in pixels. A point of
disparity d = u_L - u_R lies at z = f B / (d + c_R - c_L).

Source: Wang et al. 2024, Eq. 2 (rectified pair) and Eq. 3-7 (general coplanar pair).
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.types import Rig

# Range of disparities over the width of a line, of the 3DPIXA (Wang et al. 2024, Table 1).
_SHARP_SHARE = 330 / 7142

Camera = Literal["left", "right"]
Number = TypeVar("Number", float, Tensor)


def focal_length_px(rig: Rig) -> float:
    """Focal length in pixels: the focal length over the pixel pitch."""
    return rig.focal_length_mm / (rig.pixel_pitch_um * 1e-3)


def zero_disparity_mm(rig: Rig) -> float:
    """Depth z0, mm, of the plane of zero disparity, which both cameras see in the same column."""
    return focal_length_px(rig) * rig.baseline_mm / (rig.principal_right_px - rig.principal_left_px)


def object_pitch_mm(rig: Rig) -> float:
    """Distance on the object, mm, between neighbouring pixels at the plane of zero disparity."""
    return zero_disparity_mm(rig) / focal_length_px(rig)


def middle_point(rig: Rig) -> Float[Tensor, "3"]:
    """The point c = (B/2, 0, z0), mm, float64: midway between the cameras on the plane of zero disparity."""
    return torch.tensor([rig.baseline_mm / 2, 0.0, zero_disparity_mm(rig)], dtype=torch.float64)


def camera_center_mm(rig: Rig, camera: Camera) -> float:
    """X of a camera's optical centre in the scan frame, mm."""
    return 0.0 if camera == "left" else rig.baseline_mm


def slope_at(rig: Rig, column_px: Number, camera: Camera = "left") -> Number:
    """Slope dx/dz of the ray that a camera's (fractional) column looks along, dimensionless."""
    principal_px = rig.principal_left_px if camera == "left" else rig.principal_right_px
    return (column_px - principal_px) / focal_length_px(rig)


def scaled_rig(rig: Rig, scale: float | int) -> Rig:
    """The same cameras with ``scale`` times larger pixels over the same field; the line pitch should grow as much.

    The outer edge of the first pixel stays where it is: a column c becomes (c + 0.5) / scale - 0.5.

    Raises:
        ValueError: the scale is below 1.
    """
    if scale < 1:
        raise ValueError(f"scale must be at least 1, got {scale}")
    red, green, blue = rig.color_spacing_lines
    return dataclasses.replace(
        rig,
        width_px=math.ceil(rig.width_px / scale),
        pixel_pitch_um=rig.pixel_pitch_um * scale,
        principal_left_px=(rig.principal_left_px + 0.5) / scale - 0.5,
        principal_right_px=(rig.principal_right_px + 0.5) / scale - 0.5,
        color_spacing_lines=(red / scale, green / scale, blue / scale),
    )


def triangulate(
    rig: Rig, left_px: Float[Tensor, "*batch"], disparity_px: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Position (x, z) in the scan plane of what the left camera sees in a column, from its disparity.

    Args:
        rig: rectified rig.
        left_px: column in the left image, px.
        disparity_px: u_left - u_right, px; positive to negative around the plane of zero disparity.

    Returns:
        x and z in the scan frame, mm. NaN where the rays are parallel, diverge, or meet behind the cameras.

    Source: Wang et al. 2024, Eq. 2, with the offset of shifted sensors.
    """
    z = depth_at(rig, disparity_px)
    x = (left_px - rig.principal_left_px) * z / focal_length_px(rig)
    return x, z


def depth_at(rig: Rig, disparity_px: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Depth z, mm, of a disparity, as in ``triangulate``; NaN where the rays do not meet in front of the cameras."""
    convergence = disparity_px + (rig.principal_right_px - rig.principal_left_px)
    return (focal_length_px(rig) * rig.baseline_mm) / torch.where(convergence > 0, convergence, torch.nan)


def disparity_at(rig: Rig, z: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Disparity, px, of the points at a depth, mm: the inverse of ``depth_at``."""
    return focal_length_px(rig) * rig.baseline_mm / z - (rig.principal_right_px - rig.principal_left_px)


def disparity_at_height(rig: Rig, height_mm: float) -> float:
    """Disparity, px, of a depth that lies ``height_mm`` before the plane of zero disparity."""
    z0 = zero_disparity_mm(rig)
    return (rig.principal_right_px - rig.principal_left_px) * (z0 / (z0 - height_mm) - 1)


def depth_sigma(rig: Rig, z: Float[Tensor, "*batch"], disparity_sigma_px: Tensor | float) -> Float[Tensor, "*batch"]:
    """Standard deviation of depths z, mm, from that of their disparities, px: |dz/dd| = z² / (f B)."""
    return z.square() * (disparity_sigma_px / (focal_length_px(rig) * rig.baseline_mm))


def depth_step_mm(rig: Rig, disparity_px: float) -> float:
    """Change of depth, mm, that a change of disparity means at the plane of zero disparity."""
    return disparity_px * zero_disparity_mm(rig) ** 2 / (focal_length_px(rig) * rig.baseline_mm)


def sharp_depth_mm(rig: Rig) -> float:
    """Depth, mm, in which a rig usually sees sharp: no rig file says it, so it is the 3DPIXA's share of the field.

    That is 330 px of disparity on a line of 7142 px: 52 mm of depth for a field of 500 mm.
    """
    return depth_step_mm(rig, _SHARP_SHARE * rig.width_px)


def project(
    rig: Rig, x: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Columns (u_left, u_right) in px that see the point (x, z) mm of the scan plane; NaN behind the cameras.

    Source: inverse of Wang et al. 2024, Eq. 2.
    """
    scale = focal_length_px(rig) / torch.where(z > 0, z, torch.nan)
    return x * scale + rig.principal_left_px, (x - rig.baseline_mm) * scale + rig.principal_right_px


def triangulation_jacobian(
    rig: Rig, left_px: Float[Tensor, "*batch"], disparity_px: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 2 2"]:
    """Derivative of (x, z) by (u_left, disparity), mm/px: carries pixel noise to millimetres."""
    x, z = triangulate(rig, left_px, disparity_px)
    z_by_d = -z * z / (focal_length_px(rig) * rig.baseline_mm)
    x_by_u = z / focal_length_px(rig)
    x_by_d = x / z * z_by_d
    rows = [torch.stack([x_by_u, x_by_d], dim=-1), torch.stack([torch.zeros_like(z), z_by_d], dim=-1)]
    return torch.stack(rows, dim=-2)


def mean_column_jacobian(
    rig: Rig, left_px: Float[Tensor, "*batch"], disparity_px: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 2 2"]:
    """Derivative of (x, z) by the mean of both columns and their disparity, mm/px: independent where noise is alike."""
    by_left, by_disparity = triangulation_jacobian(rig, left_px, disparity_px).unbind(-1)
    return torch.stack([by_left, by_disparity + by_left / 2], dim=-1)


def depth_map_jacobian(
    rig: Rig, left_px: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 2 2"]:
    """Derivative of (x, z) by (u_left, z) where the depth z, mm, is measured itself."""
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    x_by_u = z / focal_length_px(rig)
    return torch.stack(
        [torch.stack([x_by_u, slope_at(rig, left_px)], dim=-1), torch.stack([zero, one], dim=-1)], dim=-2
    )


@dataclass(frozen=True)
class Intersection:
    """Where the rays of two cameras meet.

    Attributes:
        points: (x, z), mm. depth_mm: from the right camera's image plane, ``|P O_R| cos(theta_1) - f1``.
        valid: whether the rays meet in front of both cameras; the rest is NaN where they do not.
    """

    points: Float[Tensor, "*batch 2"]
    depth_mm: Float[Tensor, "*batch"]
    valid: Bool[Tensor, "*batch"]


@dataclass(frozen=True)
class CoplanarRig:
    """Two line cameras whose optical axes lie in one plane at any angle.

    Attributes:
        focal_left_mm: f2. focal_right_mm: f1. baseline_mm: B.
        alpha: angle from the left to the right optical axis, rad; 0 where they are parallel.
        beta: angle from the baseline to the left optical axis, rad; pi/2 for a rectified rig.
    """

    focal_left_mm: float
    focal_right_mm: float
    baseline_mm: float
    alpha: float
    beta: float


def triangulate_general(
    left_mm: Float[Tensor, "*batch"], right_mm: Float[Tensor, "*batch"], rig: CoplanarRig
) -> Intersection:
    """Intersect the rays of two line cameras whose axes lie in one plane at any angle (library API).

    The left centre is the origin, X points along the baseline to the right centre, Z into the scene. Angles grow
    counter-clockwise seen with X to the right and Z up. Image coordinates are signed distances from the principal point
    on a sensor behind the lens, positive when the ray turns counter-clockwise from its axis (towards smaller X).

    Args:
        left_mm: l_l, image coordinate in the left camera, mm. right_mm: l_r, in the right camera.

    Source: Wang et al. 2024, Eq. 3-7. The printed f1 term does not survive theta_1 = 0; this one is the triangle's.
    """
    theta_right = torch.atan(right_mm / rig.focal_right_mm)
    theta_left = torch.atan(left_mm / rig.focal_left_mm)
    apex = torch.sin(rig.alpha + theta_right - theta_left)  # angle at P; parallel rays make it zero
    opposite = torch.sin(rig.beta + theta_left)
    valid = (apex > torch.finfo(apex.dtype).eps) & (opposite > 0)
    distance = torch.where(valid, rig.baseline_mm * opposite / torch.where(valid, apex, 1.0), torch.nan)
    heading = rig.beta + rig.alpha + theta_right
    points = torch.stack([rig.baseline_mm + distance * torch.cos(heading), distance * torch.sin(heading)], dim=-1)
    valid = valid & (points[..., 1] > 0)
    points = torch.where(valid[..., None], points, torch.nan)
    depth = torch.where(valid, distance * torch.cos(theta_right) - rig.focal_right_mm, torch.nan)
    return Intersection(points, depth, valid)
