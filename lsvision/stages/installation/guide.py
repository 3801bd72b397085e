"""The turns of the cameras that make an object move along their Y axis, and the line pitch that makes it unstretched.

Turned by C, the cameras see the motion d = n/‖n‖ as Cᵀ d. C = Rz(ζ) Rx(ξ) brings their Y axis onto d,

    C e_y = (-sin ζ cos ξ, cos ζ cos ξ, sin ξ),     ζ = -atan2(n1, n2),  ξ = asin(n3/‖n‖),

exactly, wherever the axes of the turns lie: a shift of the cameras leaves n as it is.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import rotation_from_vector
from lsvision.stages.installation.config import InstallationConfig
from lsvision.types import Installation, LinePitch, Motion, PointShift, Transport, Turn

OBSERVED_SHARE = 0.5  # of the prior's sigma, that the sigma of a turn may be


@dataclass(frozen=True)
class Transported:
    """How the object was moved: the nominal line pitch, mm, None where scans differ in it, and the direction."""

    line_pitch_mm: float | None
    transport: Transport = "forward"


def installation_guide(
    motion: Motion, prior_sigma: float, moved: Transported, config: InstallationConfig
) -> Installation:
    """How to align the cameras with a motion that was measured.

    Args:
        motion: with its covariance. prior_sigma: of each component of n; what is hardly better known gets no advice.
    """
    about_x, about_z, stretch = _with_sigmas(motion, prior_sigma)
    n1, n2, n3 = motion.n.tolist()
    return Installation(
        angle_deg=math.degrees(math.atan2(math.hypot(n1, n3), n2)),
        sigma_deg=math.degrees(_largest_sigma(motion)),
        tolerance_deg=config.tolerance_deg,
        about_x=Turn("x", math.degrees(about_x.value), math.degrees(about_x.sigma), about_x.observed),
        about_z=Turn("z", math.degrees(about_z.value), math.degrees(about_z.sigma), about_z.observed),
        shifts=_shifts(config, camera_turn(*(turn.value * turn.observed for turn in (about_x, about_z)))),
        pitch=LinePitch(moved.line_pitch_mm, stretch.value, stretch.sigma, stretch.observed),
        transport=moved.transport,
    )


def camera_turn(about_x: float, about_z: float) -> Float[Tensor, "3 3"]:
    """The rotation C of the cameras in their former axes: about X, then about Z, rad."""
    x, z = (torch.tensor(axis, dtype=torch.float64) for axis in ((about_x, 0.0, 0.0), (0.0, 0.0, about_z)))
    return rotation_from_vector(z) @ rotation_from_vector(x)


@dataclass(frozen=True)
class _Known:
    """A function of n at the measured one, its sigma, and whether that is much less than the prior's."""

    value: float
    sigma: float
    observed: bool


def _turns_and_stretch(n: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Turns about X and Z, rad, and the stretch."""
    stretch = torch.linalg.vector_norm(n)
    return torch.stack([torch.asin(n[2] / stretch), -torch.atan2(n[0], n[1]), stretch])


def _with_sigmas(motion: Motion, prior_sigma: float) -> tuple[_Known, ...]:
    n = motion.n.double()
    by_n = jacobian(_turns_and_stretch, n)
    sigma = (by_n @ motion.covariance.double() * by_n).sum(-1).clamp(min=0).sqrt()
    most = OBSERVED_SHARE * prior_sigma * by_n.square().sum(-1).sqrt()
    values = zip(_turns_and_stretch(n).tolist(), sigma.tolist(), (sigma < most).tolist(), strict=True)
    return tuple(_Known(*each) for each in values)


def _largest_sigma(motion: Motion) -> float:
    """Of the direction of the motion, rad, whichever way it is known least."""
    across = jacobian(lambda n: torch.stack([n[0], n[2]]) / n[1], motion.n.double())
    covariance = across @ motion.covariance.double() @ across.mT
    return float(torch.linalg.eigvalsh(covariance)[-1].clamp(min=0).sqrt())


def _shifts(config: InstallationConfig, turn: Float[Tensor, "3 3"]) -> tuple[PointShift, ...]:
    positions = torch.tensor(list(config.points.values()), dtype=torch.float64)
    moved = (positions - positions.mean(0)) @ (turn - torch.eye(3, dtype=torch.float64)).mT
    return tuple(
        PointShift(name, point, tuple(shift))
        for (name, point), shift in zip(config.points.items(), moved.tolist(), strict=True)
    )
