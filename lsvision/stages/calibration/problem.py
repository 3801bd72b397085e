"""One calibration as an estimation problem: its state, its measured corners, and the poses that the state starts from.

The state is x = [θ_1, t_1, .., θ_B, t_B, n]: for each board a rotation vector about a stored nominal rotation R0 and
the position of its corners' centroid, then the motion n. ``model`` relates it to the corners.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import displace, fit_rigid, rotation_from_vector
from lsvision.stages.calibration.reduction import CorrelatedNoise, affine_rows, residual_rows


@dataclass(frozen=True)
class BoardState:
    """The components of a state: rotation vectors θ, rad, positions t, mm, and the motion n."""

    theta: Float[Tensor, "*batch boards 3"]
    position: Float[Tensor, "*batch boards 3"]
    n: Float[Tensor, "*batch 3"]

    @classmethod
    def split(cls, state: Float[Tensor, "*batch state"]) -> "BoardState":
        """The components of a state vector."""
        poses = state[..., :-3].unflatten(-1, (-1, 6))
        return cls(poses[..., :3], poses[..., 3:], state[..., -3:])

    def join(self) -> Float[Tensor, "*batch state"]:
        """The state vector of the components."""
        return torch.cat([torch.cat([self.theta, self.position], -1).flatten(-2), self.n], dim=-1)


@dataclass(frozen=True)
class MountingPitch:
    """Known angle of a board's normal about the sensor axis, and its sigma, rad."""

    angle: float
    sigma: float


@dataclass(frozen=True)
class BoardProblem:
    """Measured corners of several boards, and the nominal rotations that the state is written about.

    ``points`` are (x, y = travel, z), mm, zero where ``valid`` is false; ``noise_chol`` the Cholesky factor of their
    covariance; ``body_points`` the board points from the ``centroid`` of the valid ones, mm. ``correlated`` replaces
    ``noise_chol`` where the corners of a board err together.
    """

    points: Float[Tensor, "*batch boards corners 3"]
    noise_chol: Float[Tensor, "*batch boards corners 3 3"]
    body_points: Float[Tensor, "*batch boards corners 3"]
    centroid: Float[Tensor, "*batch boards 3"]
    valid: Bool[Tensor, "*batch boards corners"]
    rotation: Float[Tensor, "*batch boards 3 3"]
    pitch: MountingPitch | None = None
    correlated: CorrelatedNoise | None = None

    @property
    def boards(self) -> int:
        """Number of boards, B; the state has 6 B + 3 components."""
        return self.points.shape[-3]

    @property
    def values(self) -> Float[Tensor, "*batch"]:
        """How many values were measured."""
        further = 0.0 if self.correlated is None else self.correlated.further
        return 3.0 * self.valid.sum((-2, -1)) + further

    def at(self, place: tuple[int | None, ...] | Bool[Tensor, "*batch"]) -> "BoardProblem":
        """One problem of a batch by its indices, or those of a mask in a row."""
        names = ("points", "noise_chol", "body_points", "centroid", "valid", "rotation")
        correlated = None if self.correlated is None else self.correlated.at(place)
        problem = replace(self, correlated=correlated, **{name: getattr(self, name)[place] for name in names})
        if "affine_rows" in self.__dict__:  # the dear one is not computed again
            problem.__dict__["affine_rows"] = self.affine_rows[place]
        return problem

    def scaled(self, noise_scale: Float[Tensor, "*batch"]) -> "BoardProblem":
        """The problem with the covariance of the corners' noise multiplied by a factor."""
        sigma, correlated = noise_scale.sqrt()[..., None, None, None], self.correlated
        if correlated is not None:
            log_det = correlated.log_det + self.values * noise_scale.log()
            correlated = replace(correlated, rows=correlated.rows / sigma, log_det=log_det)
        return replace(self, noise_chol=self.noise_chol * sigma[..., None], correlated=correlated)

    def rotation_at(self, theta: Float[Tensor, "*#batch boards 3"]) -> Float[Tensor, "*batch boards 3 3"]:
        """Rotations exp(θ) R0 of the boards."""
        return rotation_from_vector(theta) @ self.rotation

    @cached_property
    def affine_rows(self) -> Float[Tensor, "*batch boards 13 13"]:
        """``reduction.affine_rows`` of the corners."""
        if self.correlated is not None:
            return self.correlated.rows
        return affine_rows(self.noise_chol, self.points, self.body_points, self.valid)

    @cached_property
    def residual_rows(self) -> Float[Tensor, "*batch boards 7 7"]:
        """``reduction.residual_rows`` of the corners."""
        return residual_rows(self.points, self.body_points, self.valid)

    @cached_property
    def noise_log_det(self) -> Float[Tensor, "*batch"]:
        """Log-determinant of the covariance of all valid corners' points."""
        if self.correlated is not None:
            return self.correlated.log_det
        by_corner = self.noise_chol.diagonal(dim1=-2, dim2=-1).prod(-1).log()
        return 2 * torch.where(self.valid, by_corner, 0.0).sum((-2, -1))


def nominal_problem(
    points: Float[Tensor, "*batch boards corners 3"],
    noise_chol: Float[Tensor, "*batch boards corners 3 3"],
    board_points: Float[Tensor, "*batch boards corners 3"],
    valid: Bool[Tensor, "*batch boards corners"],
    pitch: MountingPitch | None = None,
) -> tuple[BoardProblem, Float[Tensor, "*batch state"]]:
    """The problem about the poses that fit best under n = (0, 1, 0), and the state of those poses and that n."""
    n = points.new_tensor([0.0, 1.0, 0.0])
    weight = valid.to(points) / valid.sum(-1, keepdim=True)
    centroid = (weight[..., None] * board_points).sum(-2)
    body = board_points - centroid[..., None, :]
    fitted = fit_rigid(body, displace(points, n), valid)
    position = fitted.translation
    problem = BoardProblem(points, noise_chol, body, centroid, valid, fitted.rotation, pitch)
    return problem, BoardState(torch.zeros_like(position), position, n.expand(*points.shape[:-3], 3)).join()
