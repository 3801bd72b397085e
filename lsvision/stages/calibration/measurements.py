"""The corners that a calibration starts from: stacked from boards, checked for flaws, and posed as a problem."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.stages.calibration.problem import BoardProblem, MountingPitch, nominal_problem
from lsvision.types import BoardCorners

# Three times six measured values for the nine unknowns of one board.
MIN_CORNERS = 6
# Corners that extend this small a part as far across a line as along it fix no rotation about it.
_COLLINEAR = 1e-3


class Flaw(Enum):
    """Why no pose can be computed from a board."""

    TOO_FEW = f"fewer than {MIN_CORNERS} valid corners"
    POINT_NOT_FINITE = "a valid corner's point is not finite"
    COVARIANCE_NOT_FINITE = "a valid corner's covariance is not finite"
    COVARIANCE_NOT_POSITIVE = "a valid corner's covariance is not positive definite"
    COLLINEAR = "the valid corners lie on one line"


@dataclass(frozen=True)
class BoardMeasurements:
    """Measured corners of boards; leading dimensions of all but the points broadcast.

    ``points`` are (x, y = travel, z), mm, anything where ``valid`` is false; ``covariance`` is theirs, mm²;
    ``board_points`` are the corners in the board frame, mm.
    """

    points: Float[Tensor, "*batch boards corners 3"]
    covariance: Float[Tensor, "*#batch boards corners 3 3"]
    board_points: Float[Tensor, "*#batch boards corners 3"]
    valid: Bool[Tensor, "*#batch boards corners"]

    @classmethod
    def of(cls, boards: Sequence[BoardCorners]) -> "BoardMeasurements":
        """All boards of one problem, the shorter ones padded with corners that were not seen."""
        corners = max(board.points.shape[0] for board in boards)

        def stacked(name: str) -> Tensor:
            """One field of all boards."""
            fields = [getattr(board, name) for board in boards]
            return torch.stack(
                [torch.cat([field, field.new_zeros(corners - len(field), *field.shape[1:])]) for field in fields]
            )

        return cls(stacked("points"), stacked("covariance"), stacked("board_points"), stacked("valid"))

    def flaws(self) -> Mapping[Flaw, Bool[Tensor, "*_ boards"]]:
        """Which boards have which flaw."""
        valid = self.valid
        finite = torch.isfinite(self.points).all(-1) & torch.isfinite(self.board_points).all(-1)
        covariance_finite = torch.isfinite(self.covariance).all((-2, -1))
        covariance = torch.where(covariance_finite[..., None, None], self.covariance, 0.0)
        positive = torch.linalg.cholesky_ex(covariance).info == 0
        seen = valid & finite
        return {
            Flaw.TOO_FEW: valid.sum(-1) < MIN_CORNERS,
            Flaw.POINT_NOT_FINITE: (valid & ~finite).any(-1),
            Flaw.COVARIANCE_NOT_FINITE: (valid & ~covariance_finite).any(-1),
            Flaw.COVARIANCE_NOT_POSITIVE: (valid & ~positive).any(-1),
            Flaw.COLLINEAR: _collinear(self.points, seen) | _collinear(self.board_points, seen),
        }


@dataclass(frozen=True)
class SoundProblem:
    """The problem of a batch and its start, with a harmless stand-in for each problem that is not ``sound``."""

    problem: BoardProblem
    start: Float[Tensor, "*batch state"]
    sound: Bool[Tensor, "*batch"]

    @classmethod
    def of(cls, measured: BoardMeasurements, pitch: MountingPitch | None) -> "SoundProblem":
        """The problem that measured corners pose."""
        points, valid = measured.points, measured.valid
        sound = ~reduce(torch.logical_or, measured.flaws().values()).any(-1)
        keep, seen = sound[..., None, None], valid & sound[..., None, None]
        # Factored as few times as it was given: boards of one batch mostly share their noise.
        chol = torch.linalg.cholesky_ex(measured.covariance).L.expand(*points.shape, 3)
        if bool(seen.all()):  # nothing needs a stand-in, and nothing is copied
            return cls(*nominal_problem(points, chol, measured.board_points.expand(points.shape), seen, pitch), sound)
        index = torch.arange(points.shape[-2], dtype=points.dtype, device=points.device)
        stand_in = torch.stack([index, index * index, torch.zeros_like(index)], dim=-1)
        elsewhere = torch.where(keep[..., None], 0.0, stand_in)
        eye = torch.eye(3, dtype=points.dtype, device=points.device)
        points = torch.where(seen[..., None], points, elsewhere)
        board_points = torch.where(seen[..., None], measured.board_points, elsewhere)
        chol = torch.where(seen[..., None, None], chol, eye)
        return cls(*nominal_problem(points, chol, board_points, seen | ~keep, pitch), sound)


def _collinear(points: Tensor, seen: Tensor) -> Tensor:
    """Boards whose seen points lie on a line, by the eigenvalues of their second moments."""
    weight = seen.to(points) / seen.sum(-1, keepdim=True).clamp(min=1)
    known = torch.where(seen[..., None], points, 0.0)
    centered = torch.where(seen[..., None], known - (weight[..., None] * known).sum(-2, keepdim=True), 0.0)
    moments = torch.linalg.eigvalsh(centered.mT @ centered)
    return moments[..., 1] <= _COLLINEAR**2 * moments[..., 2]
