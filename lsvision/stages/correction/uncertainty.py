"""How well a product's positions are known, from the sigma of the depth, of the motion and of a repaired travel."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import ProductFrame, motion_sigma, travel_at, travel_sigma
from lsvision.types import Motion, Travel


def position_sigma(
    frame: ProductFrame,
    covariance: Float[Tensor, "3 3"],
    column: Float[Tensor, "*cells"],
    line: Float[Tensor, "*cells"],
    depth_sigma: Float[Tensor, "*cells"],
    z: Float[Tensor, "*cells"] | None = None,
) -> Float[Tensor, "*cells 3"]:
    """Standard deviation, mm, of (q_x, q_y, q_z) of cells, relative to the first line of their scan.

    An error of the depth moves a point along its ray; an error of n displaces it in proportion to its travel from the
    first line; an error of the travel of a repaired line moves it along the motion; an error of a line's own motion
    displaces and turns what it shows. Motion from line to line that was not corrected is not part of it.

    Args:
        covariance: of n. column, line: position in the scan that a cell came from, px.
        depth_sigma: of the depth there, mm.
        z: depth there, mm; needed where the frame has line motion.
    """
    along_ray = frame.ray(column, line) * depth_sigma[..., None]
    travel = travel_at(frame.travel, line) - travel_at(frame.travel, line.new_zeros(()))
    sigma = torch.hypot(along_ray, travel[..., None] * motion_sigma(frame.n, covariance))
    if frame.travel.sigma_mm is not None:
        sigma[..., 1] = sigma[..., 1].hypot(frame.stretch * travel_sigma(frame.travel, line))
    if frame.line_motion is not None and z is not None:
        by_motion = frame.displacement_jacobian(column, line, z)
        spread = (by_motion @ frame.line_motion.covariance_at(line) * by_motion).sum(-1)
        sigma = sigma.hypot(spread.clamp(min=0).sqrt())
    return sigma


@dataclass(frozen=True)
class EncoderRepair:
    """Lines of a scan whose travel was interpolated, and the largest standard deviation of their travel, mm."""

    repaired_lines: int
    largest_sigma_mm: float

    @classmethod
    def of(cls, travel: Travel) -> "EncoderRepair | None":
        """What was repaired of a scan's travel; None where nothing was."""
        if travel.sigma_mm is None:
            return None
        return cls(int((travel.sigma_mm > 0).sum()), float(travel.sigma_mm.max()))


def drift_per_metre(motion: Motion) -> tuple[float, ...]:
    """Standard deviation of (q_x, q_y, q_z) that an uncertain n adds, mm per metre of the object."""
    return tuple((1000.0 / motion.stretch * motion_sigma(motion.n, motion.covariance)).tolist())
