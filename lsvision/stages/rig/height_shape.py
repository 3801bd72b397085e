"""How wrong a rig bends the heights that it measures: what an error of the rig looks like on a flat plate.

The rays of a column pair that see a point by the true rig meet elsewhere by another. What a shift and a turn of the
whole object explain is no bend: it belongs to the pose.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import RawPair
from lsvision.stages.rig.model import QUANTITIES, Shared
from lsvision.types import RawRig

_COLUMNS, _DEPTHS = 33, 3
_FIELD_SHARE = 0.96  # of the left camera's line


@dataclass(frozen=True)
class HeightShape:
    """The derivative of height, mm, by what all boards share, over columns and depths of the field, without its tilt.

    Unknowns, and their errors, are in sigmas of the prior.
    """

    by_shared: Float[Tensor, "points shared"]

    @classmethod
    def of(cls, rig: RawRig, shared: Shared, sigma: Float[Tensor, " shared"], depth_range_mm: float) -> "HeightShape":
        """That of a rig near given values, over a depth range about its z0, mm."""
        pair, n = RawPair.of(rig, shared.quantities), shared.n
        there = _field(rig, pair, depth_range_mm)
        left, right = pair.seen_left(there, n).column, pair.seen_right(there, n).column

        def height(move: Tensor) -> Tensor:
            other = RawPair.of(rig, (shared.quantities + sigma[:QUANTITIES] * move[:QUANTITIES]).expand(len(there), -1))
            return -other.meet(left, right, n + sigma[QUANTITIES:] * move[QUANTITIES:]).z

        by_shared = jacobian(height, torch.zeros_like(sigma))
        across = there[:, 0] - there[:, 0].mean()
        tilt = torch.stack([torch.ones_like(across), across], dim=-1)
        return cls(by_shared - tilt @ torch.linalg.lstsq(tilt, by_shared).solution)

    def stated_mm(self, factor: Float[Tensor, "*batch shared columns"]) -> Float[Tensor, "*batch"]:
        """Rms bend that errors of a covariance ``factor @ factor.mT`` make, mm."""
        return (self.by_shared @ factor).square().sum(-1).mean(-1).sqrt()

    def bend_mm(self, error: Float[Tensor, "*batch shared"]) -> Float[Tensor, "*batch"]:
        """Rms bend that given errors make, mm."""
        return (error @ self.by_shared.mT).square().mean(-1).sqrt()


def _field(rig: RawRig, pair: RawPair, depth_range_mm: float) -> Float[Tensor, "points 3"]:
    """Points of the scan plane, mm, all over the field at z0 and over the depth."""
    middle, half = (rig.width_px - 1) / 2, _FIELD_SHARE * (rig.width_px - 1) / 2
    share = torch.linspace(-1, 1, _COLUMNS, dtype=torch.float64)
    z0 = pair.crossing_mm(middle)
    edges = torch.stack([pair.left.slope(z0.new_tensor(middle + side * half)) * z0 for side in (-1, 1)])
    x = torch.lerp(edges[0], edges[1], (share + 1) / 2)
    z = z0 + depth_range_mm / 2 * torch.linspace(-1, 1, _DEPTHS, dtype=torch.float64)
    x, z = torch.meshgrid(x, z, indexing="ij")
    return torch.stack([x, torch.zeros_like(x), z], dim=-1).flatten(0, 1)
