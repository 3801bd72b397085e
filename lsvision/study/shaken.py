"""Scans of boards that vibrate, simulated without images: corners, and crossings of the squares' edges on every line.

Vibration is a sum of sine waves in x, z and roll, with new phases in every scan; or the motion is random, and no sum of
a few waves. The crossings err by white noise of their mean column and of their disparity.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation.gaussian_process import covariance_root, matern32
from lsvision.geometry import (
    middle_point,
    project,
    scan_position,
    shaken,
    transform,
    triangulate,
    triangulation_jacobian,
)
from lsvision.study.points import ExactCorners
from lsvision.types import Board, BoardCorners, BoardEdges, Rig

_BEYOND_MM = 20.0  # that a scan reaches beyond its board
_FIRST_MM, _LAST_MM = -100.0, 520.0  # travel at which random motion is drawn
_INNER = (0.2, 0.8)  # part of a square's edge that is measured


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
        crossed = _crossed(board, exact, index, noise.line_pitch_mm)
        scans.edges.append(_seen(rig, crossed, motion.at(index, crossed.still[:, 1]), noise, chance))
    return scans


def _corners(exact: ExactCorners, index: int, points: Tensor, noise: ScanNoise) -> BoardCorners:
    first, last = points[:, 1].min() - _BEYOND_MM, points[:, 1].max() + _BEYOND_MM
    lines = torch.arange(float(first), float(last), noise.line_pitch_mm, dtype=torch.float64)
    covariance = noise.corner_mm**2 * torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    seen = torch.ones(len(points), dtype=torch.bool)
    body = exact.board_points[index]
    return BoardCorners(f"scan_{index}", points, covariance, seen, body, points[:, :2], travel_mm=lines)


@dataclass(frozen=True)
class _Crossed:
    """Where lines cross the edges along Y of a board that does not vibrate: (x, travel, z) in ``still``."""

    scan: str
    still: Float[Tensor, "crossings 3"]
    start: Float[Tensor, "crossings 3"]
    stop: Float[Tensor, "crossings 3"]
    segment: Int[Tensor, " crossings"]
    line: Int[Tensor, " crossings"]


def _crossed(board: Board, exact: ExactCorners, index: int, pitch_mm: float) -> _Crossed:
    nx, ny = board.inner
    grid = exact.board_points[index].unflatten(0, (ny, nx))
    start, stop = grid[:-1].flatten(0, 1), grid[1:].flatten(0, 1)
    rotation, translation = exact.rotation[index], exact.translation[index]
    begin, end = (scan_position(transform(rotation, translation, side), exact.n) for side in (start, stop))
    line = torch.arange(int(begin[:, 1].min() / pitch_mm), int(end[:, 1].max() / pitch_mm) + 1)
    share = (line * pitch_mm - begin[:, 1:2]) / (end[:, 1:2] - begin[:, 1:2])
    segment, at = ((share > _INNER[0]) & (share < _INNER[1])).nonzero().unbind(-1)
    still = torch.lerp(begin[segment], end[segment], share[segment, at][:, None])
    return _Crossed(f"scan_{index}", still, start[segment], stop[segment], segment, line[at])


def _seen(
    rig: Rig, crossed: _Crossed, motion: Float[Tensor, "crossings 4"], noise: ScanNoise, chance: torch.Generator
) -> BoardEdges:
    x, z = shaken(crossed.still[:, ::2], motion, middle_point(rig)).unbind(-1)
    left, right = project(rig, x, z)
    drawn = torch.randn(2, len(x), generator=chance, dtype=torch.float64)
    column, disparity = noise.column_px * drawn[0], noise.disparity_px * drawn[1]
    left, right = left + column + disparity / 2, right + column - disparity / 2
    by_left, by_disparity = triangulation_jacobian(rig, left, left - right).unbind(-1)
    x, z = triangulate(rig, left, left - right)
    return BoardEdges(
        scan=crossed.scan,
        points=torch.stack([x, crossed.still[:, 1], z], -1),
        by_column=torch.stack([by_left, by_disparity + by_left / 2], -1),
        sigma_px=torch.full_like(x, noise.disparity_px),
        start=crossed.start,
        stop=crossed.stop,
        segment=crossed.segment,
        line=crossed.line,
    )
