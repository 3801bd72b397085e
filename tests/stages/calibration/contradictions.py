"""Boards that contradict each other, what was said of them, or the model: corners of many sets at once."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from lsvision.geometry import scan_position
from tests.stages.calibration.boards import SIGMA, Corners, simulate, tilt, true_motion

THREE = ((10.0, 0.0, 0.0), (-8.0, 6.0, 0.0), (0.0, -10.0, 0.0))
EIGHT = (*THREE, (0.0, 8.0, -3.0), (6.0, 6.0, 10.0), (-6.0, -6.0, 3.0), (0.0, 0.0, 0.0), (12.0, -4.0, 1.0))
# One sigma of x, travel and z of corners found in the scans of another renderer, 893 px wide, mm.
DETECTED = (0.0050, 0.0045, 0.0212)


def scanned(tilts, motions: list[Tensor], sets: int, sigma=SIGMA) -> Corners:
    """Each board scanned under a motion of its own; ``n`` is the first."""
    parts = [simulate([angles], (sets,), sigma, n) for angles, n in zip(tilts, motions, strict=True)]
    stacked = {
        name: torch.cat([getattr(part, name) for part in parts], dim=1)
        for name in ("points", "covariance", "board_points", "valid")
    }
    return replace(parts[0], **stacked)


def sound(tilts, sets: int, sigma=SIGMA) -> Corners:
    """Boards under one motion."""
    return scanned(tilts, [true_motion()] * len(tilts), sets, sigma)


def noisier_than_stated(tilts, sets: int, factor: float, sigma=SIGMA) -> Corners:
    """Boards under one motion whose corners have ``factor`` times the sigma that they state."""
    corners = sound(tilts, sets, tuple(factor * s for s in sigma))
    return replace(corners, covariance=corners.covariance / factor**2)


def faster(tilts, speeds, sets: int, sigma=SIGMA) -> Corners:
    """Each board scanned at a speed of its own."""
    return scanned(tilts, [speed * true_motion() for speed in speeds], sets, sigma)


def drifting_last(tilts, drift: tuple[float, float, float], sets: int, sigma=SIGMA) -> Corners:
    """The last board scanned with another n."""
    last = true_motion() + torch.tensor(drift, dtype=torch.float64)
    return scanned(tilts, [true_motion()] * (len(tilts) - 1) + [last], sets, sigma)


def other_size(corners: Corners, stated: float) -> Corners:
    """The same corners of boards whose size was stated ``stated`` times as large as it is."""
    return replace(corners, board_points=corners.board_points * stated)


def shaken(corners: Corners, rms_mm: float, wavelength_mm: float, components: tuple[int, ...] = (0, 2)) -> Corners:
    """The same corners, each line displaced by waves of random phase: x and z shake, or the travel is wrong."""
    points, travel = corners.points.clone(), corners.points[..., 1]
    for component in components:
        phase = 2 * math.pi * torch.rand(*travel.shape[:-1], 1, dtype=torch.float64)
        wave = torch.sin(2 * math.pi / wavelength_mm * travel + phase)
        points[..., component] += rms_mm * math.sqrt(2) * wave
    return replace(corners, points=points)


def bent(corners: Corners, tilts, height_mm: float) -> Corners:
    """The same boards, bent along their longer side: by ``height_mm`` at its ends."""
    x = corners.board_points[..., 0] - corners.board_points[..., 0].mean(-1, keepdim=True)
    height = height_mm * (x / x.abs().amax()).square()
    normal = torch.stack([tilt(*angles) for angles in tilts])[:, None, :, 2]
    return replace(corners, points=corners.points + scan_position(height[..., None] * normal, corners.n))


def one_corner_off(corners: Corners, by_mm: float = 30.0) -> Corners:
    """A corner of the second board of each set lies off sideways: another one in each."""
    points, sets = corners.points.clone(), torch.arange(len(corners.points))
    points[sets, 1, (17 * sets + 5) % points.shape[-2], 0] += by_mm
    return replace(corners, points=points)


def rows_exchanged(corners: Corners, first: int, second: int) -> Corners:
    """Two rows of eleven corners of the second board stand for each other."""
    rows = corners.points.unflatten(-2, (8, 11)).clone()
    rows[:, 1, [first, second]] = rows[:, 1, [second, first]]
    return replace(corners, points=rows.flatten(-3, -2))


def with_outliers(corners: Corners, share: float, factor: float, sigma=SIGMA) -> Corners:
    """A share of all corners displaced by errors ``factor`` times as large as the others'."""
    off = torch.rand(corners.valid.shape) < share
    error = factor * torch.tensor(sigma, dtype=torch.float64) * torch.randn_like(corners.points)
    return replace(corners, points=corners.points + torch.where(off[..., None], error, 0.0))
