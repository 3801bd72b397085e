"""Synthetic corners of tilted boards, with noise as given or without."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lsvision.geometry import displace, rotation_from_vector, scan_position, transform
from lsvision.stages.calibration.problem import BoardProblem, nominal_problem
from lsvision.types import Board, BoardCorners, Rig

RIG = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375)
SIGMA = (0.020, 0.020, 0.014)  # of x, y and z, mm
THREE_TILTS = ((10.0, 0.0, 2.0), (-10.0, 5.0, 1.0), (3.0, -10.0, 0.0))

FOUR_TILTS = ((2.0, 1.5, 0.0), (-5.0, 1.0, 6.0), (5.0, -2.0, -8.0), (-1.0, -3.5, 14.0))  # those of the paper experiment


def true_motion(yaw_deg: float = 2.0, pitch_deg: float = 1.5, stretch: float = 1.0246) -> Tensor:
    """The motion n of the paper's order: two small angles and its stretch."""
    n = torch.tensor([math.tan(math.radians(yaw_deg)), 1.0, math.tan(math.radians(pitch_deg))], dtype=torch.float64)
    return n * stretch / torch.linalg.vector_norm(n)


def tilt(about_x: float, about_y: float, about_z: float) -> Tensor:
    """Rotation by three angles in degrees, about Z first."""
    axes = torch.eye(3, dtype=torch.float64)
    turns = [
        rotation_from_vector(math.radians(a) * axis) for a, axis in zip((about_x, about_y, about_z), axes, strict=True)
    ]
    return turns[0] @ turns[1] @ turns[2]


@dataclass(frozen=True)
class Corners:
    """Measured corners of boards ``(*batch, boards, corners, ..)`` and the truth behind them."""

    points: Tensor
    covariance: Tensor
    board_points: Tensor
    valid: Tensor
    n: Tensor
    rotation: Tensor
    translation: Tensor

    def problem(self) -> tuple[BoardProblem, Tensor]:
        """The estimation problem and its start."""
        return nominal_problem(self.points, torch.linalg.cholesky(self.covariance), self.board_points, self.valid)

    def boards(self) -> list[BoardCorners]:
        """One BoardCorners per board."""
        fields = (self.points, self.covariance, self.valid, self.board_points)
        return [
            BoardCorners(f"scan_{i}", points, covariance, valid, board_points, points[:, :2])
            for i, (points, covariance, valid, board_points) in enumerate(zip(*fields, strict=True))
        ]


def simulate(
    tilts=THREE_TILTS, batch: tuple[int, ...] = (), sigma=SIGMA, n: Tensor | None = None, origin=(20.0, 60.0, 800.0)
) -> Corners:
    """Corners of a GP400-12-9 board at each tilt, measured with independent noise."""
    n = true_motion() if n is None else n
    body = Board(12, 9, 30.0).corner_points()
    rotation = torch.stack([tilt(*angles) for angles in tilts])
    translation = torch.tensor(origin, dtype=torch.float64).expand(len(tilts), 3)
    exact = scan_position(transform(rotation, translation, body), n)
    sigmas = torch.tensor(sigma, dtype=torch.float64)
    points = exact + sigmas * torch.randn(*batch, *exact.shape, dtype=torch.float64)
    covariance = torch.diag(sigmas.clamp(min=1e-6) ** 2).expand(*points.shape, 3)
    valid = torch.ones(points.shape[:-1], dtype=torch.bool)
    return Corners(points, covariance, body.expand_as(points), valid, n, rotation, translation)


def drawn(tilts, prior_sigma: float, runs: int) -> Corners:
    """Corners of sets whose true n is drawn from the prior about (0, 1, 0), every ninth of each board."""
    n = torch.tensor([0.0, 1.0, 0.0]).double() + prior_sigma * torch.randn(runs, 3, dtype=torch.float64)
    nominal = thinned(simulate(tilts, batch=(runs,), sigma=(0.0, 0.0, 0.0), n=torch.tensor([0.0, 1.0, 0.0]).double()))
    exact = scan_position(displace(nominal.points, torch.tensor([0.0, 1.0, 0.0])), n[:, None, None, :])
    sigmas = torch.tensor(SIGMA, dtype=torch.float64)
    return replace(
        nominal,
        points=exact + sigmas * torch.randn_like(exact),
        covariance=torch.diag(sigmas**2).expand(*exact.shape, 3),
        n=n,
    )


def thinned(corners: Corners) -> Corners:
    """Every ninth corner of each board: ten that span it, for tests that are slow with all."""
    return replace(
        corners,
        points=corners.points[..., ::9, :].clone(),
        covariance=corners.covariance[..., ::9, :, :],
        board_points=corners.board_points[..., ::9, :],
        valid=corners.valid[..., ::9],
    )


def with_vibration(corners: Corners, rms_mm: float) -> Corners:
    """The same corners, x and z shaken by independent amounts of rms_mm together: far above the noise they claim."""
    shake = rms_mm / math.sqrt(2) * torch.randn_like(corners.points)
    shake[..., 1] = 0.0
    return replace(corners, points=corners.points + shake)
