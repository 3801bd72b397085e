"""How boards can depart from the model that one motion moves one rigid board: the extended model of the corners.

A departure d of a board is what its corners would show beyond poses and a common n:

    P(p) = (1 + scale) R p + R e_z (bend · q(p)) + t          on the object, q(p) = (p_x², p_x p_y, p_y²) / h²
    n_b  = (1 + speed) (n + (sideways, 0, depth))             the motion of this board's scan
    m(p) = scan_position(P(p), n_b)                           measured

All of it is linear in a few features of a corner (1, p_x, p_y, q(p)), so that the corners of a board are reduced once
to as many rows, on which any number of hypotheses are fitted. The rest, which no departure explains, is the corners'
own noise, or errors along the scan (see ``along_scan``). Boards are planar: p_z = 0.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import apply, chi_square_tail
from lsvision.geometry import rotation_from_vector, scan_position
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.stages.calibration.reduction import feature_rows, rows_with_latents

KINDS = ("speed", "sideways", "depth", "scale", "bend_xx", "bend_xy", "bend_yy")
_AFFINE, _QUADRATIC = 3, 3  # features of each sort
_CORNERS_FOR_BENDS = 40  # with fewer, too few are left to judge the noise by once bends are fitted


@dataclass(frozen=True)
class Placement:
    """The state of the extended model: rotations, positions, n, and the departures of the boards, in ``KINDS``."""

    rotation: Float[Tensor, "*batch boards 3 3"]
    position: Float[Tensor, "*batch boards 3"]
    n: Float[Tensor, "*batch 3"]
    departure: Float[Tensor, "*batch boards 7"]

    def motion(self) -> Float[Tensor, "*batch boards 3"]:
        """The motion of each board's scan, n_b."""
        speed, sideways, depth = self.departure[..., :3].unbind(-1)
        shift = torch.stack([sideways, torch.zeros_like(sideways), depth], dim=-1)
        return (1 + speed)[..., None] * (self.n[..., None, :] + shift)

    def moved(self, pose: Tensor, n: Tensor, departure: Tensor) -> "Placement":
        """The placement after a step; ``pose`` holds a rotation vector and a shift of each board."""
        rotation = rotation_from_vector(pose[..., :3]) @ self.rotation
        position = self.position + pose[..., 3:]
        return Placement(rotation, position, self.n + n, self.departure + departure)

    def at_poses_of(self, other: "Placement", chosen: Bool[Tensor, "*batch"]) -> "Placement":
        """The placement with another's poses and n in the chosen problems, its departures unchanged."""
        rotation = torch.where(chosen[..., None, None, None], other.rotation, self.rotation)
        position = torch.where(chosen[..., None, None], other.position, self.position)
        n = torch.where(chosen[..., None], other.n, self.n)
        return Placement(rotation, position, n, self.departure)

    def one(self, i: int) -> "Placement":
        """That of one problem of a batch of one dimension."""
        return Placement(*(getattr(self, field.name)[i] for field in fields(self)))

    def expanded(self, batch: tuple[int, ...]) -> "Placement":
        """The placement with another batch's leading dimensions."""
        inner = (3, 2, 1, 2)
        parts = (getattr(self, field.name) for field in fields(self))
        return Placement(*(part.expand(*batch, *part.shape[-k:]) for part, k in zip(parts, inner, strict=True)))


@dataclass(frozen=True)
class ReducedCorners:
    """The corners of boards, reduced to rows on the coefficients of their features.

    ``rows`` are ``[S | q]`` on the features' coefficients, in sigmas; ``noise_chi_square`` and ``noise_freedom`` are of
    the error that no features explain.
    """

    rows: Float[Tensor, "*batch boards rows columns"]
    noise_chi_square: Float[Tensor, "*batch boards"]
    noise_freedom: Float[Tensor, "*batch boards"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "ReducedCorners":
        """The corners of a problem, whose noise is ``noise_chol``, with bends of the board where there are enough."""
        rows = feature_rows(problem.noise_chol, problem.points, features(problem), problem.valid)
        return cls._of_rows(problem, rows)

    @classmethod
    def with_latents(cls, problem: BoardProblem, latents: Float[Tensor, "boards corners 3 _"]) -> "ReducedCorners":
        """The same of a problem of batch shape () whose corners err by ``latents`` too, see ``rows_with_latents``."""
        parts = (problem.noise_chol, problem.points, features(problem), problem.valid)
        return cls._of_rows(problem, rows_with_latents(*parts, latents).rows)

    @classmethod
    def _of_rows(cls, problem: BoardProblem, rows: Tensor) -> "ReducedCorners":
        freedom = (3 * problem.valid.sum(-1) - (rows.shape[-2] - 1)).clamp(min=0).to(rows)
        return cls(rows[..., :-1, :], rows[..., -1, -1].square(), freedom)

    @property
    def curved(self) -> bool:
        """Whether the features include bends of the board."""
        return self.rows.shape[-1] > 3 * _AFFINE + 1

    @property
    def smooth_freedom(self) -> int:
        """Number of the rows of a board, from which poses, n and departures take their part."""
        return self.rows.shape[-2]

    @cached_property
    def noise_scale(self) -> Float[Tensor, "*batch boards"]:
        """Variance of the corners' own noise over the stated one; 1 where it is no larger, or not known."""
        per_freedom = self.noise_chi_square / self.noise_freedom.clamp(min=1)
        unlikely = chi_square_tail(self.noise_chi_square, self.noise_freedom.clamp(min=1)) < 1e-2
        return torch.where(unlikely & (self.noise_freedom > 0), per_freedom, 1.0)

    def scaled(self) -> "ReducedCorners":
        """The same in sigmas of the noise that the corners have."""
        root = self.noise_scale.sqrt()[..., None, None]
        return replace(self, rows=self.rows / root)

    def replaced(self, i: int, one: "ReducedCorners") -> "ReducedCorners":
        """The same with one problem's, of batch shape (), in place of those of problem ``i``."""
        parts = ((getattr(self, field.name).clone(), getattr(one, field.name)) for field in fields(self))
        return ReducedCorners(*(whole.index_copy(0, torch.tensor([i]), part[None]) for whole, part in parts))


def placement(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Placement:
    """The extended model at a state of the plain one: without departures."""
    parts = BoardState.split(state)
    rotation, position = problem.rotation_at(parts.theta), parts.position
    return Placement(rotation, position, parts.n, position.new_zeros(*position.shape[:-1], len(KINDS)))


def features(problem: BoardProblem) -> Float[Tensor, "*batch boards corners features"]:
    """What a corner's measured point is linear in: 1, p_x, p_y, and where there are corners enough, q(p)."""
    plane = problem.body_points[..., :2]
    found = [torch.ones_like(plane[..., :1]), plane]
    if problem.points.shape[-2] >= _CORNERS_FOR_BENDS:
        x, y = (plane / plane.abs().amax((-2, -1), keepdim=True)).unbind(-1)
        found.append(torch.stack([x * x, x * y, y * y], dim=-1))
    return torch.cat(found, dim=-1)


def residual_and_jacobian(reduced: ReducedCorners, at: Placement) -> Float[Tensor, "*batch boards rows columns"]:
    """Rows ``[J | r]``: the columns are pose (6), n (3), departures (7) and residual.

    J dx = r is what a step dx should remove.
    """
    moved = reduced.rows[..., :-1] @ _coefficients(at, reduced.curved).flatten(-3, -2)
    return torch.cat([moved[..., :-1], (reduced.rows[..., -1] - moved[..., -1])[..., None]], dim=-1)


def corner_rows(problem: BoardProblem, at: Placement) -> Float[Tensor, "*batch boards corners 3 17"]:
    """The same of each corner, in mm, zero where it was not seen.

    All but the pose leave the board's centroid where it is measured: a shift of the board, which is a pose, makes up
    for it. Where line 0 is far away, digits would be lost otherwise.
    """
    by_feature = features(problem)
    columns = _coefficients(at, by_feature.shape[-1] > _AFFINE)
    columns[..., 0, :, 6:16] = 0.0
    rows = (by_feature @ columns.flatten(-2)).unflatten(-1, (3, 17))
    rows[..., -1] = problem.points - rows[..., -1]
    return torch.where(problem.valid[..., None, None], rows, 0.0)


def _coefficients(at: Placement, curved: bool) -> Tensor:
    """Coefficients and their derivatives, ``(*batch, boards, features, 3, 17)``."""
    count = _AFFINE + (_QUADRATIC if curved else 0)
    speed, scale = at.departure[..., :1], at.departure[..., 3, None, None]
    axes = at.rotation.mT  # (k, i): component i of R e_k
    placed = torch.cat([at.position[..., None, :], (1 + scale) * axes[..., :2, :]], dim=-2)
    if curved:
        placed = torch.cat([placed, at.departure[..., 4:, None] * axes[..., 2:, :]], dim=-2)
    turning = placed.clone()
    turning[..., 0, :] = 0.0
    eye = torch.eye(3, dtype=placed.dtype, device=placed.device)
    by_theta = torch.linalg.cross(
        eye[:, None, :].expand(*turning.shape[:-2], 3, *turning.shape[-2:]), turning[..., None, :, :]
    )
    out = placed.new_zeros(*placed.shape[:-2], count, 3, 17)
    out[..., :3] = by_theta.movedim(-3, -1)
    out[..., 0, :, 3:6] = eye
    motion = at.motion()
    travel = placed[..., 1] / motion[..., None, 1]
    by_motion = -travel[..., None, None] * eye
    out[..., 6:9] = by_motion * (1 + speed)[..., None, None]
    out[..., 9] = apply(by_motion, motion[..., None, :] / (1 + speed)[..., None])
    out[..., 10] = out[..., 6]
    out[..., 11] = out[..., 8]
    out[..., 1:_AFFINE, :, 12] = axes[..., :2, :].clone()
    if curved:
        for k in range(_QUADRATIC):
            out[..., _AFFINE + k, :, 13 + k] = axes[..., 2, :]
    out[..., 16] = placed
    return scan_position(out.mT, motion[..., None, None, :]).mT
