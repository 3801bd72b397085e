"""Projection and triangulation of a pair of line cameras.

Source: Wang et al. 2024, Eq. 2 (rectified pair) and Eq. 3-7 (general coplanar pair).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.types import Rig


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
    x = (left_px - rig.principal_left_px) * z / rig.focal_length_px
    return x, z


def depth_at(rig: Rig, disparity_px: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """z of what has a disparity, mm, as in ``triangulate``; NaN where the rays do not meet in front of the cameras."""
    convergence = disparity_px + (rig.principal_right_px - rig.principal_left_px)
    return (rig.focal_length_px * rig.baseline_mm) / torch.where(convergence > 0, convergence, torch.nan)


def project(
    rig: Rig, x: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Columns (u_left, u_right) in px that see the point (x, z) mm of the scan plane; NaN behind the cameras.

    Source: inverse of Wang et al. 2024, Eq. 2.
    """
    scale = rig.focal_length_px / torch.where(z > 0, z, torch.nan)
    return x * scale + rig.principal_left_px, (x - rig.baseline_mm) * scale + rig.principal_right_px


def triangulation_jacobian(
    rig: Rig, left_px: Float[Tensor, "*batch"], disparity_px: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 2 2"]:
    """Derivative of (x, z) by (u_left, disparity), mm/px: carries pixel noise to millimetres."""
    x, z = triangulate(rig, left_px, disparity_px)
    z_by_d = -z * z / (rig.focal_length_px * rig.baseline_mm)
    x_by_u = z / rig.focal_length_px
    x_by_d = x / z * z_by_d
    rows = [torch.stack([x_by_u, x_by_d], dim=-1), torch.stack([torch.zeros_like(z), z_by_d], dim=-1)]
    return torch.stack(rows, dim=-2)


def triangulate_general(
    left_mm: Float[Tensor, "*batch"],
    right_mm: Float[Tensor, "*batch"],
    *,
    focal_left_mm: float,
    focal_right_mm: float,
    baseline_mm: float,
    alpha: float,
    beta: float,
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Intersect the rays of two line cameras whose axes lie in one plane at any angle.

    The left centre is the origin, X points along the baseline to the right centre, Z into the scene. Angles grow
    counter-clockwise seen with X to the right and Z up. Image coordinates are signed distances from the principal point
    on a sensor behind the lens, positive when the ray turns counter-clockwise from its axis (towards smaller X).

    Args:
        left_mm: l_l, image coordinate in the left camera, mm.
        right_mm: l_r, image coordinate in the right camera, mm.
        focal_left_mm: f2. focal_right_mm: f1. baseline_mm: B.
        alpha: angle from the left to the right optical axis, rad; 0 where they are parallel.
        beta: angle from the baseline to the left optical axis, rad; pi/2 for a rectified rig.

    Returns:
        (points, depth, valid): ``points (*batch, 2)`` as (x, z) in mm, the depth from the right camera's image plane
        ``|P O_R| cos(theta_1) - f1`` in mm, and whether the rays meet in front of both cameras. NaN where they do not.

    Source: Wang et al. 2024, Eq. 3-7. The printed f1 term does not survive theta_1 = 0; this one is the triangle's.
    """
    theta_right = torch.atan(right_mm / focal_right_mm)
    theta_left = torch.atan(left_mm / focal_left_mm)
    apex = torch.sin(alpha + theta_right - theta_left)  # angle at P; parallel rays make it zero
    opposite = torch.sin(beta + theta_left)
    valid = (apex > torch.finfo(apex.dtype).eps) & (opposite > 0)
    distance = torch.where(valid, baseline_mm * opposite / torch.where(valid, apex, 1.0), torch.nan)
    heading = beta + alpha + theta_right
    points = torch.stack([baseline_mm + distance * torch.cos(heading), distance * torch.sin(heading)], dim=-1)
    valid = valid & (points[..., 1] > 0)
    points = torch.where(valid[..., None], points, torch.nan)
    depth = torch.where(valid, distance * torch.cos(theta_right) - focal_right_mm, torch.nan)
    return points, depth, valid
