"""How far the heights of a product may be off because its raw rig is not known exactly.

Such an error is the same on every line: it is no noise, and no mean over lines lessens it. What it shifts and tilts all
heights by belongs to the pose of the object; what it bends is the sigma of a cell.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import RawPair, quantities_of, rig_modes, slope_at
from lsvision.types import RawRig, Rig

_COLUMNS, _DEPTHS = 65, 5  # at which heights are compared: between them the bend is linear to a hundredth


@dataclass(frozen=True)
class RigErrors:
    """Standard deviations, mm, that the errors of a rig give to heights.

    ``bend_mm`` is of heights less a plane through all of them, over columns of the ideal left image and depths;
    ``shift_mm`` and ``tilt`` (mm per mm across) are those of the plane. ``last_column`` and ``z_range_mm`` are where
    columns, from 0 on, and depths end.
    """

    bend_mm: Float[Tensor, "columns depths"]
    shift_mm: float
    tilt: float
    last_column: float
    z_range_mm: tuple[float, float]

    @classmethod
    def of(
        cls, raw: RawRig | None, rig: Rig, n: Float[Tensor, "3"], z_range_mm: tuple[float, float]
    ) -> "RigErrors | None":
        """Those of a raw rig, whose ideal pair is ``rig``, for an object of motion n; None where it counts as exact."""
        modes = None if raw is None else rig_modes(raw)
        if raw is None or modes is None:
            return None
        last, n = rig.width_px - 1.0, n.double()
        columns = torch.linspace(0.0, last, _COLUMNS, dtype=torch.float64)
        depths = torch.linspace(*z_range_mm, _DEPTHS, dtype=torch.float64)
        column, z = (part.flatten() for part in torch.meshgrid(columns, depths, indexing="ij"))
        x = slope_at(rig, column) * z
        off = _heights_by_modes(raw, torch.stack([x, torch.zeros_like(x), z], dim=-1), n, modes)
        across = x - x.mean()
        plane = torch.stack([torch.ones_like(across), across], dim=-1)
        fitted = torch.linalg.lstsq(plane, off).solution
        bend = (off - plane @ fitted).square().sum(-1).sqrt().reshape(_COLUMNS, _DEPTHS)
        shift, tilt = fitted.square().sum(-1).sqrt().tolist()
        return cls(bend, shift, tilt, last, z_range_mm)

    def sigma_mm(self, column: Float[Tensor, "*cells"], z: Float[Tensor, "*cells"]) -> Float[Tensor, "*cells"]:
        """Standard deviation of heights at columns of the ideal left image and depths, mm."""
        table, (near, far) = self.bend_mm.to(column), self.z_range_mm
        i, across = _between(column / self.last_column, _COLUMNS)
        j, deep = _between((z - near) / (far - near), _DEPTHS)
        nearer = torch.lerp(table[i, j], table[i + 1, j], across)
        return torch.lerp(nearer, torch.lerp(table[i, j + 1], table[i + 1, j + 1], across), deep)

    @property
    def metadata(self) -> dict[str, float]:
        """What a product records of it: rms over columns and depths."""
        bend = float(self.bend_mm.square().mean().sqrt())
        return {
            "bend_sigma_um": 1e3 * bend,
            "shift_sigma_mm": self.shift_mm,
            "tilt_sigma_deg": math.degrees(math.atan(self.tilt)),
        }


def _heights_by_modes(
    raw: RawRig, there: Float[Tensor, "points 3"], n: Float[Tensor, "3"], modes: Float[Tensor, "quantities modes"]
) -> Float[Tensor, "points modes"]:
    """How much higher points of the scan plane come out by each error of the rig, mm."""
    pair, exact = RawPair.of(raw), quantities_of(raw)
    left, right = pair.seen_left(there, n).column, pair.seen_right(there, n).column

    def height(move: Tensor) -> Tensor:
        return -RawPair.of(raw, exact + modes @ move).meet(left, right, n).z

    return jacobian(height, modes.new_zeros(modes.shape[-1]))


def _between(share: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The node before places, given as shares of a row of nodes, and how far they are from it to the next."""
    at = (share.nan_to_num() * (count - 1)).clamp(0, count - 1)
    node = at.floor().clamp(max=count - 2).long()
    return node, at - node
