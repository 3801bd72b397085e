"""Where both raw cameras saw the corners of boards: columns, and the travel of each camera's own line."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import travel_at
from lsvision.image.board.refine import DetectedCorners
from lsvision.types import Board, Travel


@dataclass(frozen=True)
class CameraSighting:
    """Corners of a board in one image as (column px, travel mm), and the lower Cholesky factor of their covariance.

    Where a corner was not seen, both are anything finite.
    """

    position: Float[Tensor, "*batch corners 2"]
    factor: Float[Tensor, "*batch corners 2 2"]

    @classmethod
    def of(cls, found: DetectedCorners, valid: Bool[Tensor, " corners"], travel: Travel) -> "CameraSighting":
        """The valid ones of corners that were found in an image."""
        column, line = torch.where(valid[:, None], found.position, 0.0).unbind(-1)
        pitch = travel_at(travel, line + 0.5) - travel_at(travel, line - 0.5)
        scale = torch.stack([torch.ones_like(pitch), pitch], dim=-1)
        eye = torch.eye(2, dtype=line.dtype, device=line.device)
        covariance = torch.where(valid[:, None, None], found.covariance, eye)
        covariance = scale[..., None] * covariance * scale[..., None, :]
        return cls(torch.stack([column, travel_at(travel, line)], dim=-1), torch.linalg.cholesky(covariance))


@dataclass(frozen=True)
class Sightings:
    """What both cameras saw of the corners of boards; a corner counts, ``valid``, where both saw it."""

    left: CameraSighting
    right: CameraSighting
    valid: Bool[Tensor, "*batch boards corners"]
    board_points: Float[Tensor, "corners 3"]

    @property
    def boards(self) -> int:
        """Number of boards."""
        return self.valid.shape[-2]

    def chosen(self, index: Sequence[int] | Sequence[Sequence[int]]) -> "Sightings":
        """Some of the boards, in an order; lists of equally many boards make a batch of problems."""
        left, right = (
            CameraSighting(eye.position[..., index, :, :], eye.factor[..., index, :, :, :])
            for eye in (self.left, self.right)
        )
        return Sightings(left, right, self.valid[..., index, :], self.board_points)


def sighted(left: DetectedCorners, right: DetectedCorners, travel: Travel, board: Board) -> Sightings:
    """What both cameras saw of one board in a scan with a travel."""
    valid = left.valid & right.valid
    eyes = [CameraSighting.of(corners, valid, travel) for corners in (left, right)]
    alone = [CameraSighting(eye.position[None], eye.factor[None]) for eye in eyes]
    return Sightings(alone[0], alone[1], valid[None], board.corner_points())


def joined(parts: Sequence[Sightings]) -> Sightings:
    """Sightings of boards of one kind, one after the other."""
    left, right = (
        CameraSighting(torch.cat([eye.position for eye in eyes]), torch.cat([eye.factor for eye in eyes]))
        for eyes in ([part.left for part in parts], [part.right for part in parts])
    )
    return Sightings(left, right, torch.cat([part.valid for part in parts]), parts[0].board_points)
