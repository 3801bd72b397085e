"""Line cameras, triangulation, motion and rigid transforms: batched, differentiable, float64."""

from lsvision.geometry.camera import depth_at, project, triangulate, triangulate_general, triangulation_jacobian
from lsvision.geometry.motion import (
    displace,
    from_product,
    line_at,
    product_axes,
    scan_position,
    to_product,
    travel_at,
)
from lsvision.geometry.rigid import (
    euler_angles,
    fit_rigid,
    left_jacobian,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)

__all__ = [
    "depth_at",
    "displace",
    "euler_angles",
    "fit_rigid",
    "from_product",
    "left_jacobian",
    "line_at",
    "product_axes",
    "project",
    "rotation_from_vector",
    "scan_position",
    "to_product",
    "transform",
    "travel_at",
    "triangulate",
    "triangulate_general",
    "triangulation_jacobian",
    "vector_from_rotation",
]
