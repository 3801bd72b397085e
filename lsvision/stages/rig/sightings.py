"""Where both raw cameras saw the corners of boards: columns, and the travel of each camera's own line."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import travel_at
from lsvision.image.board.detect import detect_board
from lsvision.image.board.refine import DetectedCorners
from lsvision.types import Board, LineImage, Travel

_FEWEST = 20  # corners of a board that both cameras must see


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


@dataclass(frozen=True)
class RawScan:
    """The images of a raw pair of cameras, and the travel of their lines."""

    name: str
    left: LineImage
    right: LineImage
    travel: Travel


def find_sightings(scan: RawScan, board: Board) -> Sightings:
    """Find a board in both images of a scan; the result is of one board.

    Raises:
        BoardNotFoundError: an image without the board, or too few corners that both cameras see; names the scan.
    """
    mirrored, found = scan.travel.transport == "reverse", []
    for side, image in (("left", scan.left), ("right", scan.right)):
        corners = detect_board(image, board, mirrored=mirrored)
        if corners is None:
            size = f"{board.columns} x {board.rows}"
            raise BoardNotFoundError(f"{scan.name}: no board of {size} squares in the {side} image")
        found.append(corners)
    valid = found[0].valid & found[1].valid
    if int(valid.sum()) < _FEWEST:
        raise BoardNotFoundError(f"{scan.name}: only {int(valid.sum())} corners in both images, {_FEWEST} are needed")
    left, right = (CameraSighting.of(corners, valid, scan.travel) for corners in found)
    return joined([Sightings(left, right, valid, board.corner_points())], new=True)


def joined(parts: Sequence[Sightings], *, new: bool = False) -> Sightings:
    """Sightings of boards one after the other; with ``new`` each part is that of a single board without an axis."""
    put = torch.stack if new else torch.cat
    left, right = (
        CameraSighting(put([eye.position for eye in eyes]), put([eye.factor for eye in eyes]))
        for eyes in zip(*((part.left, part.right) for part in parts), strict=True)
    )
    return Sightings(left, right, put([part.valid for part in parts]), parts[0].board_points)
