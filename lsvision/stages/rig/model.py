"""What a raw rig, a motion and poses predict of the corners, in sigmas of the corners and of the prior.

What all boards share is in units of the prior's sigma from its mean: the quantities in the order of ``RIG_QUANTITIES``,
and the three components of n from (0, 1, 0). A pose, a rotation vector (rad) and a shift (mm) from a start, has a flat
prior. It says where the middle of the board is after the travel
at which the left camera sees it: n and the poses would be coupled by the distance to line 0 otherwise.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState
from lsvision.geometry import RawPair, fit_rigid, quantities_of, rotation_from_vector, transform
from lsvision.stages.rig.config import RigSigmas
from lsvision.stages.rig.sightings import Sightings
from lsvision.types import RIG_QUANTITIES, Pose, RawRig

QUANTITIES = len(RIG_QUANTITIES)
SHARED = QUANTITIES + 3  # unknowns that all boards share
POSE = 6


@dataclass(frozen=True)
class Shared:
    """What all boards share: the quantities of the rig, in its file's units, and n."""

    quantities: Float[Tensor, "*batch quantities"]
    n: Float[Tensor, "*batch 3"]

    @property
    def vector(self) -> Float[Tensor, "*batch shared"]:
        """Both as one vector."""
        return torch.cat([self.quantities, self.n], dim=-1)


@dataclass(frozen=True)
class RigPrior:
    """The data sheet: a rig, and the standard deviations of what all boards share."""

    rig: RawRig
    sigma: Float[Tensor, " shared"]

    @classmethod
    def of(cls, rig: RawRig, usual: RigSigmas) -> "RigPrior":
        """A rig with the sigmas that its file states, and the usual ones where it states none."""
        mean, stated = quantities_of(rig), dict(rig.sigma)
        otherwise = {
            "focal_length_mm": usual.focal_length_share,
            "principal_point_px": usual.principal_sigma_px,
            "distortion.0": usual.distortion_sigma,
            "distortion.1": usual.distortion_sigma,
            "turn_deg": usual.turn_sigma_deg,
            "baseline_mm": usual.baseline_share,
            "view_plane.offset_mm": usual.plane_sigma_mm,
            "view_plane.slope_x": usual.plane_slope_sigma,
            "view_plane.slope_z": usual.plane_slope_sigma,
        }
        relative = ("focal_length_mm", "baseline_mm")
        sigma = []
        for name, value in zip(RIG_QUANTITIES, mean.tolist(), strict=True):
            short = name.removeprefix("left.").removeprefix("right.")
            sigma.append(stated.get(name, otherwise[short] * (value if short in relative else 1.0)))
        return cls(rig, mean.new_tensor([*sigma, *[usual.motion_sigma] * 3]))

    def state(self, shared: Shared) -> Float[Tensor, "*batch shared"]:
        """Sigmas off the mean."""
        return (shared.vector - self._mean) / self.sigma

    def shared(self, state: Float[Tensor, "*batch shared"]) -> Shared:
        """The rig's quantities and n, from sigmas off the mean."""
        quantities, n = (self._mean + self.sigma * state).split([QUANTITIES, 3], dim=-1)
        return Shared(quantities, n)

    @property
    def _mean(self) -> Float[Tensor, " shared"]:
        return torch.cat([quantities_of(self.rig), self.sigma.new_tensor([0.0, 1.0, 0.0])])


@dataclass(frozen=True)
class Predicted:
    """Corners as they would be sighted: (column px, travel mm) in either camera."""

    left: Float[Tensor, "*batch boards corners 2"]
    right: Float[Tensor, "*batch boards corners 2"]


@dataclass(frozen=True)
class RigModel:
    """Boards before a rig.

    ``start`` are poses at the travel ``middle_mm`` at which the left camera sees the boards' middles; ``body_points``
    are the corners from the middle of each board.
    """

    prior: RigPrior
    start: Pose
    middle_mm: Float[Tensor, "*batch boards"]
    body_points: Float[Tensor, "*batch boards corners 3"]

    @classmethod
    def of(cls, sightings: Sightings, prior: RigPrior) -> "RigModel":
        """Start from where the corners are by the rig of the data sheet and the nominal motion."""
        pair, n = RawPair.of(prior.rig), prior.sigma.new_tensor([0.0, 1.0, 0.0])
        left, right, valid = sightings.left.position, sightings.right.position, sightings.valid[..., None]
        met = pair.meet(left[..., 0], right[..., 0], n)
        seen = torch.where(valid, torch.stack([met.x, left[..., 1], met.z], dim=-1), 0.0)
        count = valid.sum(-2).clamp(min=1)
        body = torch.where(valid, sightings.board_points, 0.0)
        body = sightings.board_points - (body.sum(-2) / count)[..., None, :]
        middle = seen[..., 1].sum(-1) / count[..., 0]
        at_middle = seen - torch.stack([torch.zeros_like(middle), middle, torch.zeros_like(middle)], -1)[..., None, :]
        return cls(prior, fit_rigid(body, at_middle, sightings.valid), middle, body)

    def placed(self, state: BorderedState) -> Float[Tensor, "*batch boards corners 3"]:
        """Where the corners are before line 0, mm."""
        n, poses = self.prior.shared(state.shared).n, state.own
        rotation = rotation_from_vector(poses[..., :3]) @ self.start.rotation
        moved = self.start.translation + poses[..., 3:] + self.middle_mm[..., None] * n[..., None, :]
        return transform(rotation, moved, self.body_points)

    def predict(self, state: BorderedState) -> Predicted:
        """Where both cameras see the corners."""
        shared, points = self.prior.shared(state.shared), self.placed(state)
        pair = RawPair.of(self.prior.rig, shared.quantities[..., None, None, :])
        n = shared.n[..., None, None, :]
        left, right = pair.seen_left(points, n), pair.seen_right(points, n)
        return Predicted(*(torch.stack([seen.column, seen.travel], dim=-1) for seen in (left, right)))
