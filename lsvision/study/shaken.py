"""Scans of boards that vibrate, simulated without images: corners, and crossings of the squares' edges on every line.

Vibration is a sum of sine waves in x, z and roll, with new phases in every scan; or the motion is random, and no sum of
a few waves. The crossings err by white noise of their mean column and of their disparity.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation.gaussian_process import covariance_root, matern32
from lsvision.geometry import mean_column_jacobian, middle_point, project, shaken, triangulate
from lsvision.study.edges import exact_edges
from lsvision.study.points import ExactCorners
from lsvision.types import Board, BoardCorners, BoardEdges, Pose, Rig

_BEYOND_MM = 20.0  # that a scan reaches beyond its board
_FIRST_MM, _LAST_MM = -100.0, 520.0  # travel at which random motion is drawn


@dataclass(frozen=True)
class Vibration:
    """Waves of x, z, mm, and roll, rad: ``size`` is the rms of each, ``phase`` is by board."""

    size: Float[Tensor, "3"]
    wavelength_mm: Float[Tensor, " waves"]
    phase: Float[Tensor, "boards 3 waves"]

    @classmethod
    def drawn(
        cls, size: Sequence[float], wavelength_mm: Sequence[float], boards: int, chance: torch.Generator
    ) -> "Vibration":
        """Waves of random phases."""
        phase = torch.rand(boards, 3, len(wavelength_mm), generator=chance, dtype=torch.float64)
        length = torch.tensor(wavelength_mm, dtype=torch.float64)
        return cls(torch.tensor(size, dtype=torch.float64), length, 2.0 * math.pi * phase)

    def at(self, board: int, travel_mm: Float[Tensor, " lines"]) -> Float[Tensor, "lines 4"]:
        """(δx, δz, ρ, δy) of lines of some travel."""
        angle = 2.0 * math.pi * travel_mm[:, None, None] / self.wavelength_mm + self.phase[board]
        waves = torch.sin(angle).sum(-1) * math.sqrt(2.0 / len(self.wavelength_mm))
        return pad(self.size * waves, (0, 1))


@dataclass(frozen=True)
class RandomMotion:
    """Random motion of x, z, mm, and roll, rad, at every millimetre of travel: a Matérn process of order 3/2."""

    values: Float[Tensor, "boards 3 places"]

    @classmethod
    def drawn(cls, size: Sequence[float], length_mm: float, boards: int, chance: torch.Generator) -> "RandomMotion":
        """Motion of an rms ``size`` of each and some correlation length, another on every board."""
        place = torch.arange(_FIRST_MM, _LAST_MM, dtype=torch.float64)
        root = covariance_root(matern32((place[:, None] - place) / length_mm))
        white = torch.randn(boards, 3, len(place), 1, generator=chance, dtype=torch.float64)
        return cls(torch.tensor(size, dtype=torch.float64)[:, None] * (root @ white)[..., 0])

    def at(self, board: int, travel_mm: Float[Tensor, " lines"]) -> Float[Tensor, "lines 4"]:
        """(δx, δz, ρ, δy) of lines of some travel; beyond the ends, those there."""
        place = (travel_mm - _FIRST_MM).clamp(0.0, self.values.shape[-1] - 1.001)
        first, values = place.long(), self.values[board]
        return pad(torch.lerp(values[:, first], values[:, first + 1], place - first).mT, (0, 1))


Motion = Vibration | RandomMotion


@dataclass(frozen=True)
class ScanNoise:
    """Sigmas of a corner's coordinates, mm, and of a crossing's mean column and disparity, px; pitch of the lines."""

    corner_mm: float = 0.005
    column_px: float = 0.03
    disparity_px: float = 0.02
    line_pitch_mm: float = 0.6


@dataclass(frozen=True)
class ShakenScans:
    """Corners and edges of boards that moved, as a calibration takes them."""

    corners: list[BoardCorners]
    edges: list[BoardEdges]


def shaken_scans(
    rig: Rig, board: Board, exact: ExactCorners, motion: Motion, noise: ScanNoise, chance: torch.Generator
) -> ShakenScans:
    """Scans of boards whose lines a motion displaced."""
    scans = ShakenScans([], [])
    for index, points in enumerate(exact.points):
        moved = points + noise.corner_mm * torch.randn(points.shape, generator=chance, dtype=torch.float64)
        moved[:, ::2] = shaken(moved[:, ::2], motion.at(index, points[:, 1]), middle_point(rig))
        scans.corners.append(_corners(exact, index, moved, noise))
        pose = Pose(exact.rotation[index], exact.translation[index])
        still = replace(exact_edges(rig, board, pose, exact.n, noise.line_pitch_mm), scan=scans.corners[index].scan)
        scans.edges.append(_seen(rig, still, motion.at(index, still.points[:, 1]), noise, chance))
    return scans


def _corners(exact: ExactCorners, index: int, points: Tensor, noise: ScanNoise) -> BoardCorners:
    first, last = points[:, 1].min() - _BEYOND_MM, points[:, 1].max() + _BEYOND_MM
    lines = torch.arange(float(first), float(last), noise.line_pitch_mm, dtype=torch.float64)
    covariance = noise.corner_mm**2 * torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    seen = torch.ones(len(points), dtype=torch.bool)
    body = exact.board_points[index]
    return BoardCorners(f"scan_{index}", points, covariance, seen, body, points[:, :2], travel_mm=lines)


def _seen(
    rig: Rig, edges: BoardEdges, motion: Float[Tensor, "crossings 4"], noise: ScanNoise, chance: torch.Generator
) -> BoardEdges:
    """Edges whose lines a motion displaced, with noise."""
    x, z = shaken(edges.points[:, ::2], motion, middle_point(rig)).unbind(-1)
    left, right = project(rig, x, z)
    drawn = torch.randn(2, len(x), generator=chance, dtype=torch.float64)
    column, disparity = noise.column_px * drawn[0], noise.disparity_px * drawn[1]
    left, right = left + column + disparity / 2, right + column - disparity / 2
    x, z = triangulate(rig, left, left - right)
    return replace(
        edges,
        points=torch.stack([x, edges.points[:, 1], z], -1),
        by_column=mean_column_jacobian(rig, left, left - right),
        sigma_px=torch.full_like(x, noise.disparity_px),
    )
