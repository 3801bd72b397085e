"""Which pose of the board to scan next: the one whose scan makes the heights of the field best known."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState, shared_information
from lsvision.geometry import RawPair, rotation_from_vector
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import POSE, RigModel
from lsvision.stages.rig.solve import RigSolution, corner_residuals
from lsvision.types import Pose

_TILT_SHARE, _DEPTH_SHARE = 0.4, 0.3  # of the sharp depth: what a tilt spans, and how far the board is moved


@dataclass(frozen=True)
class Proposal:
    """A pose for the next scan, by how the board lies, and what the heights would be known to with it.

    ``turned`` is whether its longer side lies along the travel; ``about_x`` and ``about_y`` are tilts, rad, positive
    turns in the scan frame; ``sideways_mm`` and ``deeper_mm`` are from the middle of the field.
    """

    turned: bool
    about_x: float
    about_y: float
    sideways_mm: float
    deeper_mm: float
    height_error_um: float

    @property
    def in_words(self) -> str:
        """The scan to make, for a reader."""
        words = [f"lay the board with its longer side {'along the travel' if self.turned else 'across the travel'}"]
        if self.about_x:
            words.append(
                f"raise the edge that is scanned {'first' if self.about_x > 0 else 'last'} by {_deg(self.about_x)}"
            )
        if self.about_y:
            side = "larger" if self.about_y > 0 else "smaller"
            words.append(f"raise the edge at the {side} columns by {_deg(self.about_y)}")
        if self.sideways_mm:
            side = "larger" if self.sideways_mm > 0 else "smaller"
            words.append(f"move it {abs(self.sideways_mm):.0f} mm towards the {side} columns")
        if self.deeper_mm:
            way = "away from" if self.deeper_mm > 0 else "towards"
            words.append(f"move it {abs(self.deeper_mm):.0f} mm {way} the cameras")
        return f"{', '.join(words)}: heights would be known to {self.height_error_um:.2g} um (rms over the field)"


def next_scan(solution: RigSolution, shape: HeightShape, depth_range_mm: float) -> Proposal:
    """The pose that helps most, of those within the cameras' depth and field.

    Args:
        solution: of one problem; the noise of the next scan is that of its first board.
    """
    poses = _candidates(solution, depth_range_mm)
    precision = torch.linalg.inv(solution.whitened_covariance) + _information(solution, poses) / solution.noise_scale**2
    factor = torch.linalg.cholesky(torch.linalg.inv(precision))
    bends = shape.stated_mm(solution.model.prior.in_sigmas(factor))
    best = int(bends.argmin())
    turned, about_x, about_y, sideways, deeper = poses[best].tolist()
    return Proposal(bool(turned), about_x, about_y, sideways, deeper, 1e3 * float(bends[best]))


def _deg(angle: float) -> str:
    return f"{abs(math.degrees(angle)):.1f} deg"


def _candidates(solution: RigSolution, depth_range_mm: float) -> Float[Tensor, "poses 5"]:
    """All poses of ``Proposal``, mm and rad."""
    body, sides = solution.model.body_points[0], []
    longer, shorter = (body.amax(0) - body.amin(0))[:2].tolist()
    rig = solution.model.prior.rig
    half_field = float(RawPair.of(rig).field_mm(rig.width_px)) / 2
    steps = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    for turned in (0.0, 1.0):
        across, along = (shorter, longer) if turned else (longer, shorter)
        about_x, about_y = (
            math.asin(min(1.0, _TILT_SHARE * depth_range_mm / extent)) * steps for extent in (along, across)
        )
        sideways = max(0.0, half_field - across / 2) * steps
        deeper = _DEPTH_SHARE * depth_range_mm * steps
        sides.append(torch.cartesian_prod(steps.new_tensor([turned]), about_x, about_y, sideways, deeper))
    return torch.cat(sides)


def _information(solution: RigSolution, poses: Float[Tensor, "poses 5"]) -> Float[Tensor, "poses shared shared"]:
    """Information on what all boards share of one more scan of the first board in given poses."""
    model, count = solution.model, len(poses)
    turned, about_x, about_y, sideways, deeper = poses.unbind(-1)
    zero = torch.zeros_like(turned)
    axes = (about_x, zero, zero), (zero, about_y, zero), (zero, zero, turned * math.pi / 2)
    about_x, about_y, in_plane = (rotation_from_vector(torch.stack(axis, dim=-1)) for axis in axes)
    middle = RawPair.of(model.prior.rig).middle + torch.stack([sideways, zero, deeper], dim=-1)
    start = Pose((about_x @ about_y @ in_plane)[:, None], middle[:, None])
    simulated = RigModel(model.prior, start, zero[:, None], model.body_points[:1].expand(count, 1, -1, -1))
    first = solution.sightings.chosen([0])

    def residual(state: BorderedState) -> Tensor:
        return corner_residuals(simulated, first, state).flatten(-2)

    shared = solution.found.state.shared.expand(count, -1)
    return shared_information(residual, BorderedState(shared, shared.new_zeros(count, 1, POSE)))[:, 0]
