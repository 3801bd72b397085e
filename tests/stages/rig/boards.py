"""Sightings of boards by a raw rig, exact or with noise."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import RawPair, quantities_of, rotation_from_vector, transform
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.types import Board, RawCamera, RawRig

TURN = math.radians(12.522717)
DATA_SHEET = RawRig(7142, 10.0, 354.0, RawCamera(113.84, 3570.5, TURN), RawCamera(113.84, 3570.5, -TURN))
# How far the true rig may be from the data sheet: the quantities in their order.
TOLERANCE = (0.57, 1.0, 0.3, 0.02, 0.002, 0.57, 1.0, 0.3, 0.02, 0.002, 0.35, 0.3, 0.0035, 0.0035)
BOARD = Board(7, 5, 52.0)  # as large as a GP400-12-9, with a quarter of its corners
PITCH_MM, NOISE_PX = 0.07, 0.03


def draw(*shape: int) -> Tensor:
    """Uniform from -1 to 1."""
    return 2 * torch.rand(*shape, dtype=torch.float64) - 1


@dataclass(frozen=True)
class Truth:
    """Rigs and motions, ``(runs, quantities)`` and ``(runs, 3)``."""

    quantities: Tensor
    n: Tensor

    @classmethod
    def drawn(cls, runs: int) -> "Truth":
        off = torch.tensor(TOLERANCE, dtype=torch.float64) * draw(runs, len(TOLERANCE))
        return cls(quantities_of(DATA_SHEET) + off, torch.tensor([0.0, 1.0, 0.0]).double() + 0.025 * draw(runs, 3))

    @property
    def vector(self) -> Tensor:
        return torch.cat([self.quantities, self.n], dim=-1)


def scanned(
    truth: Truth, boards: int, noise: float = NOISE_PX, stated: float = NOISE_PX, n_by_board: Tensor | None = None
) -> Sightings:
    """Boards of a balanced design: across and along, tilted by 4 deg either way, either side of the field, 20 mm apart.

    Args:
        noise: of the columns, px; ``stated`` is what their covariance says.
    """
    runs, index = len(truth.n), torch.arange(boards)
    a, b, c = (((index >> bit) & 1).double() for bit in range(3))
    along, about_x, about_y, sideways, deeper = (
        (2 * ((sum(bits)) % 2) - 1) for bits in ([a], [b], [c], [b, c], [a, b, c])
    )
    few = 1 + 0.05 * draw(5, runs, boards)
    zero = torch.zeros(runs, boards, dtype=torch.float64)
    tilt = torch.stack([math.radians(4) * about_x * few[0], math.radians(4) * about_y * few[1], zero], dim=-1)
    yaw = torch.stack([zero, zero, math.pi / 4 * (1 + along) + 0.1 * few[2]], dim=-1)
    rotation = rotation_from_vector(tilt) @ rotation_from_vector(yaw)
    places = [177 + torch.where(along > 0, 130.0, 80.0) * sideways * few[3], zero + 200, 796.9 + 20 * deeper * few[4]]
    middle = torch.stack(places, dim=-1)
    body = BOARD.corner_points()
    points = transform(rotation, middle, (body - body.mean(0)).expand(runs, boards, -1, 3))
    pair = RawPair.of(DATA_SHEET, truth.quantities[:, None, None])
    n = truth.n[:, None, None] if n_by_board is None else n_by_board[:, :, None]
    sigma = torch.tensor([noise, noise * PITCH_MM], dtype=torch.float64)
    factor = torch.tensor([stated, stated * PITCH_MM], dtype=torch.float64).diag()
    eyes = []
    for seen in (pair.seen_left(points, n), pair.seen_right(points, n)):
        exact = torch.stack([seen.column, seen.travel], dim=-1)
        eyes.append(CameraSighting(exact + sigma * torch.randn_like(exact), factor.expand(*exact.shape, 2)))
    return Sightings(eyes[0], eyes[1], torch.ones(points.shape[:-1], dtype=torch.bool), body)


def first_of(sightings: Sightings) -> Sightings:
    """The first problem of a batch."""
    eyes = [CameraSighting(eye.position[0], eye.factor[0]) for eye in (sightings.left, sightings.right)]
    return Sightings(eyes[0], eyes[1], sightings.valid[0], sightings.board_points)
