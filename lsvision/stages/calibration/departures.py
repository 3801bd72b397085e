"""How boards can depart from the model that one motion moves one rigid board: the extended model of the corners.

A departure d of a board is what its corners would show beyond poses and a common n:

    P(p) = (1 + scale) R p + R e_z (bend · q(p)) + t          on the object, q(p) = (p_x², p_x p_y, p_y²) / h²
    n_b  = (1 + speed) (n + (sideways, 0, depth))             the motion of this board's scan
    m(p) = scan_position(P(p), n_b) + wander(travel)          measured; wander is linear between knots along the scan

All of it is linear in a few features of a corner (1, p_x, p_y, q(p), curves along the scan), so that the corners of a
board are reduced once to as many rows, on which any number of hypotheses are fitted. The rest, which no departure
explains, is the corners' own noise. Boards are planar: p_z = 0.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import apply, chi_square_tail
from lsvision.geometry import rotation_from_vector, scan_position
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.stages.calibration.reduction import feature_rows

KINDS = ("speed", "sideways", "depth", "scale", "bend_xx", "bend_xy", "bend_yy")
KNOTS = 8  # along a scan: as many as a board of 12 x 9 squares has lines of corners
_AFFINE, _QUADRATIC = 3, 3  # features of each sort; the curves follow
_CORNERS_FOR_CURVES = 40  # with fewer, too few are left to judge the noise by once curves are fitted


@dataclass(frozen=True)
class Placement:
    """The state of the extended model: rotations, positions, n, and the departures of the boards, in ``KINDS``."""

    rotation: Float[Tensor, "*batch boards 3 3"]
    position: Float[Tensor, "*batch boards 3"]
    n: Float[Tensor, "*batch 3"]
    departure: Float[Tensor, "*batch boards 7"]
    wander: Float[Tensor, "*batch boards wander"]

    def motion(self) -> Float[Tensor, "*batch boards 3"]:
        """The motion of each board's scan, n_b."""
        speed, sideways, depth = self.departure[..., :3].unbind(-1)
        shift = torch.stack([sideways, torch.zeros_like(sideways), depth], dim=-1)
        return (1 + speed)[..., None] * (self.n[..., None, :] + shift)

    def moved(self, pose: Tensor, n: Tensor, departure: Tensor, wander: Tensor) -> "Placement":
        """The placement after a step; ``pose`` holds a rotation vector and a shift of each board."""
        rotation = rotation_from_vector(pose[..., :3]) @ self.rotation
        position = self.position + pose[..., 3:]
        return Placement(rotation, position, self.n + n, self.departure + departure, self.wander + wander)

    def at_poses_of(self, other: "Placement", chosen: Bool[Tensor, "*batch"]) -> "Placement":
        """The placement with another's poses and n in the chosen problems, its departures unchanged."""
        rotation = torch.where(chosen[..., None, None, None], other.rotation, self.rotation)
        position = torch.where(chosen[..., None, None], other.position, self.position)
        n = torch.where(chosen[..., None], other.n, self.n)
        return Placement(rotation, position, n, self.departure, self.wander)

    def expanded(self, batch: tuple[int, ...]) -> "Placement":
        """The placement with another batch's leading dimensions."""
        inner = (3, 2, 1, 2, 2)
        parts = (getattr(self, field.name) for field in fields(self))
        return Placement(*(part.expand(*batch, *part.shape[-k:]) for part, k in zip(parts, inner, strict=True)))


@dataclass(frozen=True)
class ReducedCorners:
    """The corners of boards, reduced to rows on the coefficients of their features.

    ``rows`` are ``[S | q]`` on the features' coefficients, ``wander`` those on the values of the knots along each scan,
    both in sigmas; ``noise_chi_square`` and ``noise_freedom`` are of the error that no features explain.
    """

    rows: Float[Tensor, "*batch boards rows columns"]
    wander: Float[Tensor, "*batch boards rows knots"]
    noise_chi_square: Float[Tensor, "*batch boards"]
    noise_freedom: Float[Tensor, "*batch boards"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "ReducedCorners":
        """The corners of a problem, with curves where there are corners enough."""
        size = problem.body_points[..., :2].abs().amax((-2, -1))
        low, knot_mm = _knots(problem)
        curved = problem.points.shape[-2] >= _CORNERS_FOR_CURVES
        features = [torch.ones_like(problem.body_points[..., :1]), problem.body_points[..., :2]]
        if curved:
            features += [_squares(problem.body_points, size), _hats(problem, low, knot_mm) @ _curves(size).mT]
        rows = feature_rows(problem.noise_chol, problem.points, torch.cat(features, dim=-1), problem.valid)
        smooth, last = rows[..., :-1, :], rows[..., -1, -1].square()
        freedom = (3 * problem.valid.sum(-1) - smooth.shape[-2]).clamp(min=0).to(size)
        return cls(smooth, _wander_rows(smooth, low, knot_mm), last, freedom)

    @property
    def curved(self) -> bool:
        """Whether the features include curves of the board and along the scan."""
        return self.wander.shape[-1] > 0

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
        return replace(self, rows=self.rows / root, wander=self.wander / root)

    def taken(self, chosen: Bool[Tensor, "*batch"]) -> "ReducedCorners":
        """The chosen problems of a batch."""
        return ReducedCorners(*(getattr(self, field.name)[chosen] for field in fields(self)))


def placement(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Placement:
    """The extended model at a state of the plain one: without departures."""
    parts = BoardState.split(state)
    rotation, position = problem.rotation_at(parts.theta), parts.position
    nothing = position.new_zeros(*position.shape[:-1], len(KINDS) + 3 * KNOTS)
    return Placement(rotation, position, parts.n, nothing[..., : len(KINDS)], nothing[..., len(KINDS) :])


def residual_and_jacobian(reduced: ReducedCorners, at: Placement) -> Float[Tensor, "*batch boards rows columns"]:
    """Rows ``[J | r]``: the columns are pose (6), n (3), departures (7), wander (three of each knot) and residual.

    J dx = r is what a step dx should remove.
    """
    columns = _coefficients(at, reduced.curved)
    S, q = reduced.rows[..., :-1], reduced.rows[..., -1]
    moved = S[..., : 3 * columns.shape[-3]] @ columns.flatten(-3, -2)
    residual = q - moved[..., -1]
    if not reduced.curved:
        return torch.cat([moved[..., :-1], residual[..., None]], dim=-1)
    residual = residual - apply(reduced.wander, at.wander)
    wander = reduced.wander.expand(*moved.shape[:-1], -1)
    return torch.cat([moved[..., :-1], wander, residual[..., None]], dim=-1)


def _coefficients(at: Placement, curved: bool) -> Tensor:
    """Coefficients and their derivatives, ``(*batch, boards, features, 3, 17)``; none of the curves along the scan."""
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


def _squares(body_points: Tensor, size: Tensor) -> Tensor:
    x, y = (body_points[..., :2] / size[..., None, None]).unbind(-1)
    return torch.stack([x * x, x * y, y * y], dim=-1)


def _knots(problem: BoardProblem) -> tuple[Tensor, Tensor]:
    """Travel of the first knot of each scan, and the distance of the knots, mm."""
    y = problem.points[..., 1]
    low = torch.where(problem.valid, y, torch.inf).amin(-1)
    high = torch.where(problem.valid, y, -torch.inf).amax(-1)
    return low, (high - low).clamp(min=1e-6) / (KNOTS - 1)


def _hats(problem: BoardProblem, low: Tensor, knot_mm: Tensor) -> Tensor:
    """Weights of the knots at each corner, linear between them."""
    position = (problem.points[..., 1] - low[..., None]) / knot_mm[..., None]
    knots = torch.arange(KNOTS, dtype=position.dtype, device=position.device)
    return (1 - (position[..., None] - knots).abs()).clamp(min=0)


def _curves(like: Tensor) -> Tensor:
    """Orthonormal values at the knots of curves without mean and slope, ``(curves, knots)``."""
    steps = torch.arange(KNOTS, dtype=like.dtype, device=like.device)
    straight = torch.stack([torch.ones_like(steps), steps])
    return torch.linalg.qr(torch.cat([straight, torch.eye(KNOTS)[: KNOTS - 2].to(straight)]).mT).Q[:, 2:].mT


def _wander_rows(rows: Tensor, low: Tensor, knot_mm: Tensor) -> Tensor:
    """Rows on the wander's values at the knots: its mean and slope lie in the affine features, its curves in others.

    The travel of the affine features is the measured one: the wander is small.
    """
    features = (rows.shape[-1] - 1) // 3
    if features == _AFFINE:
        return rows[..., :0]
    S = rows[..., :-1].unflatten(-1, (features, 3))
    affine = torch.linalg.solve_triangular(
        rows[..., : 3 * _AFFINE, : 3 * _AFFINE], rows[..., : 3 * _AFFINE, -1:], upper=True
    )
    travel = affine[..., 0].unflatten(-1, (_AFFINE, 3))[..., 1]
    steps = torch.arange(KNOTS, dtype=rows.dtype, device=rows.device)
    slope = (steps - steps.mean()) / (steps - steps.mean()).square().sum()
    # Values g have the mean 1/K Σ g and the slope Σ slope g per knot, about the middle knot.
    place = travel / knot_mm[..., None]
    place[..., 0] -= low / knot_mm + steps.mean()
    by_affine = place[..., :, None] * slope
    by_affine[..., 0, :] += 1 / KNOTS
    weights = torch.cat([by_affine, rows.new_zeros(*by_affine.shape[:-2], _QUADRATIC, KNOTS)], dim=-2)
    weights = torch.cat([weights, _curves(rows).expand(*by_affine.shape[:-2], -1, -1)], dim=-2)
    return torch.einsum("...rfc,...fk->...rkc", S, weights).flatten(-2)
