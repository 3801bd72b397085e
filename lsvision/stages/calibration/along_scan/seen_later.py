"""Corners that the cameras of a raw pair see at different moments: the motion in between displaces what they measure.

Where the planes of two cameras are apart, the right one shows a corner some millimetres of travel after the left one.
Its column is that of an object which has moved from one line to the other besides n, and the corner is measured where
the rays of the two moments meet.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import project, triangulate
from lsvision.stages.calibration.along_scan.posterior import Processes
from lsvision.types import BoardCorners, Rig


@dataclass(frozen=True)
class SeenLater:
    """After which travel the right camera saw each corner that the left one did, mm; ``rig`` is the ideal pair."""

    later_mm: Float[Tensor, "boards corners"]
    rig: Rig

    @classmethod
    def of(cls, boards: Sequence[BoardCorners], rig: Rig) -> "SeenLater | None":
        """That of boards, shorter ones padded; None where both cameras saw all corners at once."""
        if all(board.later_mm is None for board in boards):
            return None
        later = boards[0].points.new_zeros(len(boards), max(len(board.points) for board in boards))
        for row, board in zip(later, boards, strict=True):
            if board.later_mm is not None:
                row[: len(board.points)] = board.later_mm.nan_to_num(0.0)
        return cls(later, rig)

    def off(self, processes: Processes, points: Float[Tensor, "boards corners 3"]) -> Float[Tensor, "boards corners 3"]:
        """What measured points (x, travel, z), mm, are off by."""
        zero = torch.zeros_like(self.later_mm)
        there = points + torch.stack([zero, self.later_mm, zero], dim=-1)
        further = points + processes.displaced(there) - processes.displaced(points)
        left, _ = project(self.rig, points[..., 0], points[..., 2])
        _, right = project(self.rig, further[..., 0], further[..., 2])
        x, z = triangulate(self.rig, left, left - right)
        return torch.stack([x - points[..., 0], zero, z - points[..., 2]], dim=-1)
