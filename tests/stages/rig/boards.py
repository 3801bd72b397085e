"""Sightings of boards by raw rigs off their data sheet, on the scans of the study."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lsvision.geometry import quantities_of
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.model import RigPrior, Shared
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.study.rig_scans import RigConditions, board_poses, scanned
from lsvision.types import Board, RawCamera, RawRig

TURN = math.radians(12.522717)
DATA_SHEET = RawRig(7142, 10.0, 354.0, RawCamera(113.84, 3570.5, TURN), RawCamera(113.84, 3570.5, -TURN))
CONFIG = RigConfig()
PRIOR = RigPrior.of(DATA_SHEET, CONFIG)
# How far the true rig may be from the data sheet: the quantities in their order.
TOLERANCE = (0.57, 1.0, 0.3, 0.02, 0.002, 0.57, 1.0, 0.3, 0.02, 0.002, 0.35, 0.3, 0.0035, 0.0035)
BOARD = Board(7, 5, 52.0)  # as large as a GP400-12-9, with a quarter of its corners


@dataclass(frozen=True)
class Truth:
    """Rigs and motions, ``(runs, quantities)`` and ``(runs, 3)``."""

    quantities: Tensor
    n: Tensor

    @classmethod
    def drawn(cls, runs: int) -> "Truth":
        """Within the tolerance."""
        tolerance, straight = (torch.tensor(values, dtype=torch.float64) for values in (TOLERANCE, (0.0, 1.0, 0.0)))
        off, turned = (2 * torch.rand(runs, size, dtype=torch.float64) - 1 for size in (len(TOLERANCE), 3))
        return cls(quantities_of(DATA_SHEET) + tolerance * off, straight + 0.025 * turned)

    @property
    def vector(self) -> Tensor:
        """Both."""
        return torch.cat([self.quantities, self.n], dim=-1)

    def scanned(self, boards: int, noise: float = 1.0, n: Tensor | None = None) -> Sightings:
        """Boards with the usual noise times ``noise``, which their covariance does not say; ``n`` by board."""
        usual = RigConditions(boards=boards)
        conditions = replace(usual, column_sigma_px=noise * usual.column_sigma_px, line_sigma=noise * usual.line_sigma)
        n = self.n[:, None] if n is None else n
        truth = Shared(self.quantities[:, None].expand(-1, n.shape[1], -1), n)
        poses = board_poses(DATA_SHEET, BOARD, conditions, len(n))
        return restated(scanned(DATA_SHEET, truth, poses, BOARD, conditions), 1 / noise)


def restated(sightings: Sightings, ratio: float) -> Sightings:
    """The same with stated sigmas a ratio as large."""
    eyes = [CameraSighting(eye.position, ratio * eye.factor) for eye in (sightings.left, sightings.right)]
    return replace(sightings, left=eyes[0], right=eyes[1])


def first_of(sightings: Sightings, index: int = 0) -> Sightings:
    """The first problem of a batch, or another one."""
    eyes = [CameraSighting(eye.position[index], eye.factor[index]) for eye in (sightings.left, sightings.right)]
    return Sightings(eyes[0], eyes[1], sightings.valid[index], sightings.board_points)
