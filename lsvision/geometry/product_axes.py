"""The axes of the product frame: vectors, points, poses and sigmas between the scan frame and that of a motion n.

Rows of the rotation are e_y = n / ‖n‖, e_z = the viewing direction Z made orthogonal to e_y, and e_x = e_y x e_z.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.motion import scan_position
from lsvision.types import Pose


def product_axes(n: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation that takes scan-frame vectors to the product frame; its rows are e_x, e_y and e_z."""
    e_y = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    z = torch.zeros_like(n)
    z[..., 2] = 1.0
    e_z = z - e_y[..., 2:3] * e_y
    e_z = e_z / torch.linalg.vector_norm(e_z, dim=-1, keepdim=True)
    e_x = torch.linalg.cross(e_y, e_z, dim=-1)
    return torch.stack([e_x, e_y, e_z], dim=-2)


def aligned_rotation(n: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation R_scan_from_product: turns an object so that its Y runs along the motion n."""
    return product_axes(n).mT


def product_pose(pose: Pose, n: Float[Tensor, "3"]) -> Pose:
    """A pose given in the scan frame, in the product frame of the motion n."""
    axes = product_axes(n)
    return Pose(axes @ pose.rotation, axes @ pose.translation)


def to_product(measured: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Product coordinates q, mm, of measured (x, y = travel, z), mm.

    Written per component, so that q_x and q_z stay exact however far the scan has travelled.
    """
    axes = product_axes(n)
    e_x, e_y, e_z = axes[..., 0, :], axes[..., 1, :], axes[..., 2, :]
    x, y, z = measured.unbind(-1)
    q_x = x * e_x[..., 0] + z * e_x[..., 2]
    q_y = torch.linalg.vector_norm(n, dim=-1) * y + x * e_y[..., 0] + z * e_y[..., 2]
    q_z = x * e_z[..., 0] + z * e_z[..., 2]
    return torch.stack([q_x, q_y, q_z], dim=-1)


def from_product(product: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Measured (x, y = travel, z), mm, of product coordinates q, mm: the inverse of ``to_product``."""
    return scan_position((product_axes(n).mT @ product[..., None])[..., 0], n)


def motion_sigma(n: Float[Tensor, "3"], covariance: Float[Tensor, "3 3"]) -> Float[Tensor, "3"]:
    """Standard deviation of n along e_x, e_y and e_z, from its covariance in the scan frame."""
    axes = product_axes(n)
    return (axes @ covariance @ axes.mT).diagonal().clamp(min=0).sqrt()
