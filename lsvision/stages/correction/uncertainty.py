"""How well a product's positions are known, from the sigma of the depth and of the motion."""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import ProductFrame, motion_sigma, travel_at
from lsvision.types import Motion


def position_sigma(
    frame: ProductFrame,
    covariance: Float[Tensor, "3 3"],
    column: Float[Tensor, "*cells"],
    line: Float[Tensor, "*cells"],
    depth_sigma: Float[Tensor, "*cells"],
) -> Float[Tensor, "*cells 3"]:
    """Standard deviation, mm, of (q_x, q_y, q_z) of cells, relative to the first line of their scan.

    An error of the depth moves a point along its ray; an error of n displaces it in proportion to its travel from the
    first line.

    Args:
        covariance: of n. column, line: position in the scan that a cell came from, px.
        depth_sigma: of the depth there, mm.
    """
    along_ray = frame.ray(column) * depth_sigma[..., None]
    travel = travel_at(frame.travel, line) - travel_at(frame.travel, line.new_zeros(()))
    return torch.hypot(along_ray, travel[..., None] * motion_sigma(frame.n, covariance))


def drift_per_metre(motion: Motion) -> tuple[float, ...]:
    """Standard deviation of (q_x, q_y, q_z) that an uncertain n adds, mm per metre of the object."""
    return tuple((1000.0 / motion.stretch * motion_sigma(motion.n, motion.covariance)).tolist())
