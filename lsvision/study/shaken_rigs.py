"""Scans of boards that vibrate before raw rigs, simulated without images: on its own line, each camera."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import RawPair, shaken, transform
from lsvision.geometry.raw_pair import Seen
from lsvision.stages.rig.model import Shared
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.study.rig_scans import RigConditions, board_poses, from_middle
from lsvision.study.shaken import Motion
from lsvision.types import Board, Pose, RawRig

_ROUNDS = 3  # a moved point is seen on another line by what the plane is inclined, hundredths


@dataclass(frozen=True)
class ShakenBoards:
    """Boards before a true rig: by the data sheet ``rig``, in ``poses`` of their middles, moved by n and a motion."""

    rig: RawRig
    truth: Shared
    board: Board
    poses: Pose
    motion: Motion

    @classmethod
    def placed(
        cls, rig: RawRig, truth: Shared, board: Board, conditions: RigConditions, motion: Motion
    ) -> "ShakenBoards":
        """Boards as in the study of rigs; torch's generator of random numbers is used."""
        poses = board_poses(rig, board, conditions, 1)
        return cls(rig, truth, board, Pose(poses.rotation[0], poses.translation[0]), motion)

    def sightings(self, conditions: RigConditions) -> Sightings:
        """What both cameras see of the corners, with noise; torch's generator of random numbers is used."""
        body = from_middle(self.board).expand(len(self.poses.translation), -1, 3)
        left, right = (self._seen(body, left) for left in (True, False))
        sigma = body.new_tensor([conditions.column_sigma_px, conditions.line_sigma * conditions.line_pitch_mm])
        of_left, of_right = (
            CameraSighting(exact + sigma * torch.randn_like(exact), sigma.diag().expand(*exact.shape, 2))
            for exact in (left, right)
        )
        return Sightings(of_left, of_right, torch.ones(body.shape[:-1], dtype=torch.bool), self.board.corner_points())

    def _seen(self, body: Float[Tensor, "boards points 3"], left: bool) -> Float[Tensor, "boards points 2"]:
        """(Column, travel) at which one camera sees points of the boards."""
        pair, n = RawPair.of(self.rig, self.truth.quantities), self.truth.n
        camera = pair.seen_left if left else pair.seen_right
        still = transform(self.poses.rotation, self.poses.translation, body)
        seen = camera(still, n)
        for _ in range(_ROUNDS):
            seen = camera(self._moved(still, seen, pair), n)
        return torch.stack([seen.column, seen.travel], dim=-1)

    def _moved(self, still: Tensor, seen: Seen, pair: RawPair) -> Float[Tensor, "boards points 3"]:
        """Points displaced by the motion of the lines on which they are seen."""
        motion = torch.stack([self.motion.at(board, travel) for board, travel in enumerate(seen.travel)])
        there = still - seen.travel[..., None] * self.truth.n
        moved = there.clone()
        moved[..., ::2] = shaken(there[..., ::2], motion, pair.middle)
        return moved + seen.travel[..., None] * self.truth.n
