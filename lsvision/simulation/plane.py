"""Flat surfaces under line cameras: each line of a camera is a one-dimensional homography of the plane."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.simulation.trajectory import Rays
from lsvision.types import Pose


@dataclass(frozen=True)
class PlaneView:
    """What rays see of the plane Z = 0 of a frame.

    Attributes:
        x, y: position in the frame, mm, float32 ``(h, w)``; y counts from ``base_y`` nodes of the texture.
        z: depth in the scan frame, mm.
        scan_x: x in the scan frame, mm.
    """

    x: Tensor
    y: Tensor
    z: Tensor
    scan_x: Tensor
    base_y: int


def view_plane(rays: Rays, pose: Pose, spacing_mm: float) -> PlaneView:
    """Where rays meet the plane Z = 0 of a frame.

    With the ray ``o + z (k a + g)`` in the frame, ``z = -o3 / (k a3 + g3)`` and every coordinate is a quotient of two
    functions linear in k. Their coefficients are formed in float64, one set per line, and y counts from a whole number
    of texture nodes near the middle of the lines, so that the float32 quotient is exact to micrometres.
    """
    local = rays.in_frame(pose)
    origin, across, ahead = local.origin, local.across, local.ahead
    middle = len(origin) // 2
    middle_y = origin[middle, 1] - origin[middle, 2] * ahead[middle, 1] / ahead[middle, 2]
    base_y = round(float(middle_y) / spacing_mm)
    origin = origin - origin.new_tensor([0.0, base_y * spacing_mm, 0.0])
    offset = origin * ahead[:, 2:] - origin[:, 2:] * ahead
    gain = origin * across[:, 2:] - origin[:, 2:] * across
    scale = 1.0 / ahead[:, 2:]
    offset, gain, depth, tilt = ((c * scale).float() for c in (offset, gain, -origin[:, 2:], across[:, 2:]))
    k = rays.slope[None]
    inverse = torch.reciprocal(torch.addcmul(torch.ones(()), tilt, k))
    x, y = (torch.addcmul(offset[:, c, None], gain[:, c, None], k).mul_(inverse) for c in (0, 1))
    z = inverse.mul_(depth)
    return PlaneView(x, y, z, rays.scan_x(z), base_y)


def footprint(position: Tensor) -> float:
    """Width, mm, of the box that one sample covers along an axis, from the positions ``(h, w)`` of all samples.

    It has the variance of the true, turned footprint, whose sides along the sensor and along the motion add in squares.
    """
    i, j = position.shape[0] // 2, position.shape[1] // 2
    here = position[i, j]
    return float(torch.hypot(position[i, j - 1] - here, position[i - 1, j] - here)) if min(position.shape) > 1 else 1e-6


def coverage(position: Tensor, low: float, high: float, width: float) -> Tensor:
    """Share, 0..1, of a box of the given width around each position that lies within ``low..high``."""
    inside = (high - low) / 2 - (position - (low + high) / 2).abs_()
    return inside.div_(width).add_(0.5).clamp_(0.0, 1.0)


def square_wave(position: Tensor, side: float, width: float) -> Tensor:
    """Box-filtered square wave, -1..1: +1 on [0, side), -1 on [side, 2 side), and so on."""
    phase = position.mul(0.5 / side).sub_(0.25)
    phase -= phase.floor()
    return phase.sub_(0.5).abs_().sub_(0.25).mul_(4.0 * side / width).clamp_(-1.0, 1.0)
