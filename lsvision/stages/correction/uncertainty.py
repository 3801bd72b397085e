"""How well a product's positions are known: from the matching, and from what the calibration leaves open."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import product_axes, travel_at
from lsvision.stages.disparity.depth import MatchedDepth
from lsvision.types import LineImage, Motion, Scan


@dataclass(frozen=True)
class MatchedSigma:
    """The standard deviation of a matched depth map, mm, as a ``LineImage``."""

    depth: MatchedDepth

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, 1)."""
        return self.depth.shape

    @property
    def dtype(self) -> torch.dtype:
        """float32."""
        return self.depth.dtype

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1``."""
        return self.depth.read_sigma(start, stop)


def sigma_of(depth: LineImage) -> LineImage | None:
    """The standard deviation of a depth map where its matcher tells it."""
    if isinstance(depth, MatchedDepth) and depth.config.tells_sigma:
        return MatchedSigma(depth)
    return None


def position_sigma(
    scan: Scan,
    motion: Motion,
    line: Float[Tensor, "*cells"],
    column: Float[Tensor, "*cells"],
    q_z: Float[Tensor, "*cells"],
    disparity_sigma_px: float,
    depth_sigma: Float[Tensor, "*cells"] | None = None,
) -> Float[Tensor, "*cells 3"]:
    """Standard deviation, mm, of (q_x, q_y, q_z) of cells, relative to the first line of their scan.

    The depth moves a point along its ray; an error of n carries it off in proportion to its travel from the first line.

    Args:
        line, column: position in the scan that a cell came from. q_z: its depth in the product frame, mm.
        disparity_sigma_px: of the matching, used where ``depth_sigma``, mm, is None.
    """
    axes, rig = product_axes(motion.n), scan.rig
    slope = (column - rig.principal_left_px) / rig.focal_length_px
    if depth_sigma is None:
        z = q_z / (slope * axes[2, 0] + axes[2, 2])
        depth_sigma = disparity_sigma_px * z.square() / (rig.focal_length_px * rig.baseline_mm)
    along_ray = (slope[..., None] * axes[:, 0] + axes[:, 2]) * depth_sigma[..., None]
    travel = travel_at(scan.travel, line) - travel_at(scan.travel, line.new_zeros(()))
    carried_off = travel[..., None] * _sigma_per_mm(motion)
    return torch.hypot(along_ray, carried_off)


def drift_per_metre(motion: Motion) -> tuple[float, float, float]:
    """What the calibration leaves open of (q_x, q_y, q_z), as one standard deviation in mm per metre of the object."""
    across, along, height = (1000.0 / motion.stretch * _sigma_per_mm(motion)).tolist()
    return across, along, height


def _sigma_per_mm(motion: Motion) -> Float[Tensor, "3"]:
    """Standard deviation of n along e_x, e_y and e_z."""
    axes = product_axes(motion.n)
    return (axes @ motion.covariance @ axes.mT).diagonal().clamp(min=0).sqrt()
