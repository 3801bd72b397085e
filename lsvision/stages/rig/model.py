"""What a raw rig, a motion and poses predict of the corners, in sigmas of the corners and of the prior.

What all boards share, the quantities in the order of ``RIG_QUANTITIES`` and the three components of n, is in units of
the prior: its mean plus ``root`` times a state whose components are independent and of variance 1. A pose, a rotation
vector (rad) and a shift (mm) from a start, has a flat prior. It says where the middle of the board is after the travel
at which the left camera sees it: n and the poses would be coupled by the distance to line 0 otherwise.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.geometry import RawPair, fit_rigid, quantities_of, rig_covariance, rotation_from_vector, transform
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
    """The data sheet: a rig, and what is known of what all boards share; ``root @ root.mT`` is its covariance."""

    rig: RawRig
    root: Float[Tensor, "shared shared"]

    @classmethod
    def of(cls, rig: RawRig, usual: RigSigmas) -> "RigPrior":
        """A rig with its file's covariance, or the sigmas that it states and the usual ones where it states none.

        A calibrated rig's covariance is of a plane that counts depth from that rig's own z0, as the estimate does that
        starts from it.
        """
        of_rig = _own_sigmas(rig, usual).diag() if rig.covariance is None else _root(rig_covariance(rig))
        return cls(rig, torch.block_diag(of_rig, usual.motion_sigma * torch.eye(3, dtype=of_rig.dtype)))

    @property
    def sigma(self) -> Float[Tensor, " shared"]:
        """Standard deviations of what all boards share."""
        return self.root.square().sum(-1).sqrt()

    def in_sigmas(self, factor: Float[Tensor, "*batch shared columns"]) -> Float[Tensor, "*batch shared columns"]:
        """Errors of states as errors of what all boards share, in its sigmas; zero of what is exact."""
        return (self.root / _not_zero(self.sigma)[:, None]) @ factor

    def over_sigma(self, error: Float[Tensor, "*batch shared"]) -> Float[Tensor, "*batch shared"]:
        """Errors of what all boards share, in its sigmas; zero of what is exact."""
        return error / _not_zero(self.sigma)

    def shared(self, state: Float[Tensor, "*batch shared"]) -> Shared:
        """The rig's quantities and n, from a state."""
        quantities, n = (self.mean + state @ self.root.mT).split([QUANTITIES, 3], dim=-1)
        return Shared(quantities, n)

    @property
    def mean(self) -> Float[Tensor, " shared"]:
        """The data sheet's quantities, and (0, 1, 0)."""
        return torch.cat([quantities_of(self.rig), self.root.new_tensor([0.0, 1.0, 0.0])])


def _own_sigmas(rig: RawRig, usual: RigSigmas) -> Float[Tensor, " quantities"]:
    """The sigmas of a rig's quantities that its file states, and the usual ones where it states none."""
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
    return mean.new_tensor(sigma)


def _root(covariance: Float[Tensor, "quantities quantities"]) -> Float[Tensor, "quantities quantities"]:
    """A square root of a covariance, singular or not, whose rows are of very different sizes."""
    sigma = covariance.diagonal().clamp(min=0.0).sqrt()
    unit = _not_zero(sigma)
    return sigma[:, None] * covariance_root(covariance / torch.outer(unit, unit))


def _not_zero(sigma: Float[Tensor, " shared"]) -> Float[Tensor, " shared"]:
    return torch.where(sigma > 0, sigma, 1.0)


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
        pair, n = RawPair.of(prior.rig), prior.mean[QUANTITIES:]
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
