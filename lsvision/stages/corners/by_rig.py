"""What an error of a raw rig does to the corners that are measured with it."""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import RawPair, quantities_of, rig_modes, travel_at
from lsvision.types import Scan


def points_by_rig(
    scan: Scan,
    left_px: Float[Tensor, "corners 2"],
    right_px: Float[Tensor, "corners 2"],
    weight: Float[Tensor, " corners"],
    n: Float[Tensor, "3"],
) -> Float[Tensor, "corners 3 modes"] | None:
    """How far points (x, travel, z), mm, are off by each of the rig's independent errors of one sigma.

    None where the rig is rectified, or counts as exact.

    Args:
        left_px, right_px: corners in the raw images. weight: of the left line in the travel. n: motion of the object.
    """
    raw = scan.raw_rig
    modes = None if raw is None else rig_modes(raw)
    if raw is None or modes is None:
        return None
    exact, travel = quantities_of(raw), [travel_at(scan.travel, at[:, 1]) for at in (left_px, right_px)]

    def points(move: Tensor) -> Tensor:
        met = RawPair.of(raw, exact + modes @ move).meet(left_px[:, 0], right_px[:, 0], n)
        return torch.stack([met.x, weight * travel[0] + (1 - weight) * (travel[1] - met.later_mm), met.z], dim=-1)

    return jacobian(points, modes.new_zeros(modes.shape[-1]))
