"""What the corners of boards say about the boards' poses and the motion n: the measurement model of the calibration.

The state is x = [θ_1, t_1, .., θ_B, t_B, n]: for each board a rotation vector about a stored nominal rotation R0 and
the position of its corners' centroid, then n. A corner measured at (x, y, z) with covariance Σ and board point p (from
the centroid) has the residual

    e = (x, 0, z) + y n - (exp(θ) R0 p + t),      Cov e = M Σ Mᵀ,   M = [e_x | n | e_z].

It is linear in t and n, and only θ needs cubature points. All corners of a board are predicted by one affine map of
their board points: a board's measurements are reduced once, exactly, to thirteen rows on the map's twelve coefficients,
and a linearisation costs the same for any number of corners. M⁻¹ is ``scan_position``: it turns a displacement of the
object into one of the measurement. The derivative by n is the predicted travel, not the measured: the noise of y,
multiplied by an n that the board cannot show, would pass for knowledge of it.

Source: Wang et al. 2024, Eq. 10-18; M generalises its R + σ_y² n nᵀ to noise that is correlated.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import Rows, apply, lower_factor, slr, upper_root
from lsvision.estimation.square_root import forward_substitute
from lsvision.geometry import displace, fit_rigid, rotation_from_vector, scan_position, transform

# Spread, rad and mm, of cubature points that stand for one point: the model there is its tangent to ten digits.
POINT_SPREAD = 1e-6

# Boards whose whitened corners are reduced at once: some 2 MB, as much as stays near a processor.
_BOARDS_IN_CACHE = 64
_LATENTS = 3  # of the error of a board's linearised rotation


@dataclass(frozen=True)
class MountingPitch:
    """Known angle of a board's normal about the sensor axis, and its standard deviation, rad."""

    angle: float
    sigma: float


@dataclass(frozen=True)
class BoardProblem:
    """Measured corners of several boards, and the nominal poses that the state is written about.

    ``points`` are (x, y = travel, z), mm, zero where ``valid`` is false; ``noise_chol`` the Cholesky factor of their
    covariance; ``body_points`` the board points from the centroid of the valid ones, mm.
    """

    points: Float[Tensor, "*batch boards corners 3"]
    noise_chol: Float[Tensor, "*batch boards corners 3 3"]
    body_points: Float[Tensor, "*batch boards corners 3"]
    centroid: Float[Tensor, "*batch boards 3"]
    valid: Bool[Tensor, "*batch boards corners"]
    rotation: Float[Tensor, "*batch boards 3 3"]
    pitch: MountingPitch | None = None

    @property
    def boards(self) -> int:
        """Number of boards, B; the state has 6 B + 3 components."""
        return self.points.shape[-3]

    @cached_property
    def affine_rows(self) -> Float[Tensor, "*batch boards 13 13"]:
        """Whitened rows ``[S | q]`` of the affine map (1, p) -> measured: all that a board's corners say.

        For a map c, its three values at 1, then those at each component of p, ‖q - S c‖² is the squared whitened error
        of all valid corners.
        """
        parts = (self.noise_chol, self.points, self.body_points, self.valid)
        if self.valid.ndim < 3:
            return _affine_rows(*parts)
        step = max(1, _BOARDS_IN_CACHE // self.boards)
        return torch.cat([_affine_rows(*pieces) for pieces in zip(*(part.split(step) for part in parts), strict=True)])

    @cached_property
    def residual_rows(self) -> Float[Tensor, "*batch boards 7 7"]:
        """Rows of (1, p, x, y, z) of the valid corners, reduced: all that sums of squared residuals depend on."""
        rows = torch.cat([torch.ones_like(self.points[..., :1]), self.body_points, self.points], dim=-1)
        return upper_root(torch.where(self.valid[..., None], rows, 0.0))

    @cached_property
    def noise_log_det(self) -> Float[Tensor, "*batch"]:
        """Log-determinant of the covariance of all valid corners' points."""
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
    rotation, position = fit_rigid(body, displace(points, n), valid)
    problem = BoardProblem(points, noise_chol, body, centroid, valid, rotation, pitch)
    return problem, join_state(torch.zeros_like(position), position, n.expand(*points.shape[:-3], 3))


def join_state(
    theta: Float[Tensor, "*batch boards 3"], position: Float[Tensor, "*batch boards 3"], n: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch state"]:
    """State vector of rotation vectors, positions and n."""
    return torch.cat([torch.cat([theta, position], -1).flatten(-2), n], dim=-1)


def split_state(
    state: Float[Tensor, "*batch state"],
) -> tuple[Float[Tensor, "*batch boards 3"], Float[Tensor, "*batch boards 3"], Float[Tensor, "*batch 3"]]:
    """Rotation vectors, positions and n of a state vector."""
    poses = state[..., :-3].unflatten(-1, (-1, 6))
    return poses[..., :3], poses[..., 3:], state[..., -3:]


def squared_residuals(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards"]:
    """Sums ‖e‖², mm², of the residuals of each board's valid corners."""
    theta, position, n = split_state(state)
    rotation = rotation_from_vector(theta) @ problem.rotation
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    motion = torch.stack([eye[0].expand_as(n), n, eye[2].expand_as(n)], dim=-2)[..., None, :, :]
    coefficients = torch.cat([-position[..., None, :], -rotation.mT, motion.expand_as(rotation)], dim=-2)
    error = (problem.residual_rows[..., None] * coefficients[..., None, :, :]).sum(-2)
    return error.square().sum((-2, -1))


def whitened_residuals(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch rows"]:
    """Measured less predicted values in standard deviations, exactly: three a corner, and one of a mounting pitch."""
    theta, position, n = split_state(state)
    rotation = rotation_from_vector(theta) @ problem.rotation
    predicted = scan_position(transform(rotation, position, problem.body_points), n[..., None, None, :])
    error = torch.linalg.solve_triangular(problem.noise_chol, (problem.points - predicted)[..., None], upper=False)
    rows = torch.where(problem.valid[..., None], error[..., 0], 0.0).flatten(-3)
    if problem.pitch is None:
        return rows
    return torch.cat([rows, (problem.pitch.angle - _pitch_angle(problem, theta)) / problem.pitch.sigma], dim=-1)


def linearise(
    problem: BoardProblem, mean: Float[Tensor, "*batch state"], factor: Float[Tensor, "*batch state columns"]
) -> Rows:
    """Whitened rows of all corners about a Gaussian state, at most ten a board (and one of a known mounting pitch).

    The linearisation's errors of different boards are taken as independent.
    """
    rows = upper_root(_affine_model(problem, mean, factor))
    by_latents = rows[..., :_LATENTS, :_LATENTS].diagonal(dim1=-2, dim2=-1).abs().log().sum((-2, -1))
    by_motion = problem.valid.sum((-2, -1)) * mean[..., -2].abs().log()
    joined = _scatter(rows[..., _LATENTS:, _LATENTS:])
    if problem.pitch is not None:
        joined = torch.cat([joined, _pitch_row(problem, problem.pitch, mean, factor)], dim=-2)
    return Rows(joined, problem.noise_log_det + 2 * (by_latents + by_motion))


def corner_rows(
    problem: BoardProblem, mean: Float[Tensor, "*batch state"], factor: Float[Tensor, "*batch state columns"]
) -> Float[Tensor, "*batch boards corners 3 columns"]:
    """Whitened rows ``[A | r]`` of each corner alone, about a Gaussian state: for a filter that takes them in turn."""
    A, error, residual = _measured_model(problem, mean, factor)
    columns = torch.cat([error, A, residual[..., None]], dim=-1)
    columns = torch.linalg.solve_triangular(problem.noise_chol, columns, upper=False)
    error, rows = columns[..., :3], columns[..., 3:]
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device).expand_as(error)
    rows = torch.linalg.solve_triangular(lower_factor(torch.cat([eye, error], dim=-1)), rows, upper=False)
    rows = torch.where(problem.valid[..., None, None], rows, 0.0)
    return _scatter(rows.flatten(-3, -2)).unflatten(-2, (*problem.valid.shape[-2:], 3))


def motion_information(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch 3 3"]:
    """Fisher information of the corners on n, the poses being unknown; without any prior on n or on the poses."""
    size = state.shape[-1]
    spread = POINT_SPREAD * torch.eye(size, dtype=state.dtype, device=state.device)
    rows = linearise(problem, state, spread.expand(*state.shape, size)).matrix[..., :-1]
    root = upper_root(rows)[..., -3:, -3:]
    return root.mT @ root


def rotations(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch boards 3 3"]:
    """Rotations of the boards, exp(θ) R0."""
    return rotation_from_vector(split_state(state)[0]) @ problem.rotation


def translations(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch boards 3"]:
    """Translations T of the boards, mm: where the board frames' origins lie."""
    position = split_state(state)[1]
    return position - apply(rotations(problem, state), problem.centroid)


def _affine_rows(noise_chol: Tensor, points: Tensor, body_points: Tensor, valid: Tensor) -> Tensor:
    """``BoardProblem.affine_rows`` of some of a batch."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    eye = eye.reshape(3, 3, *(1,) * valid.ndim).expand(3, 3, *valid.shape)
    right = torch.cat([eye, points.movedim(-1, 0)[:, None]], dim=1)
    whitened = forward_substitute(noise_chol.movedim((-2, -1), (0, 1)), right)
    # Whitener and whitened points as (*batch, boards, column, row, corner): corners side by side in memory.
    whitened = torch.where(valid, whitened, 0.0).movedim((1, 0), (-3, -2))
    columns = points.new_empty(*whitened.shape[:-3], 13, *whitened.shape[-2:])
    columns[..., :3, :, :], columns[..., 12, :, :] = whitened[..., :3, :, :], whitened[..., 3, :, :]
    for k, component in enumerate(body_points.unbind(-1)):
        by_point = columns[..., 3 + 3 * k : 6 + 3 * k, :, :]
        torch.mul(whitened[..., :3, :, :], component[..., None, None, :], out=by_point)
    # In one layout whatever comes before: the order of sums, and so their last bits, follows it.
    return upper_root(columns.flatten(-2).mT).contiguous()


def _affine_model(problem: BoardProblem, mean: Tensor, factor: Tensor) -> Tensor:
    """All corners' whitened rows, ``(*batch, boards, 16, 13)``, the unit prior of the latents below them.

    The columns are three latents of the linearisation's error, the board's nine unknowns and the residual. The map from
    board points to measured ones is linear in its columns t, R e_x, R e_y, R e_z, each taken through M⁻¹.
    """
    theta, position, n = split_state(mean)
    A, b, error = slr(lambda vector: _rotation_columns(problem, vector), theta, _theta_chol(problem, factor))
    turned = (apply(A, theta) + b).unflatten(-1, (3, 3))
    by_theta = torch.cat([error, A], dim=-1).unflatten(-2, (3, 3))
    placed = torch.cat([position[..., None, :], turned], dim=-2)
    travel = placed[..., 1] / n[..., None, None, 1]

    moves = mean.new_zeros(*placed.shape, _LATENTS + 9)
    moves[..., 1:, :, :6] = by_theta
    moves[..., 0, :, 6:9] = torch.eye(3, dtype=mean.dtype, device=mean.device)
    moves[..., 9:] = -travel[..., None, None] * torch.eye(3, dtype=mean.dtype, device=mean.device)
    columns = torch.cat([moves, placed[..., None]], dim=-1)
    columns = scan_position(columns.mT, n[..., None, None, None, :]).mT.flatten(-3, -2)
    # A sum, not a matrix product: the last bits of that depend on the batch.
    root = problem.affine_rows
    rows = (root[..., :-1, None] * columns[..., None, :, :]).sum(-2)
    rows[..., -1] = root[..., -1] - rows[..., -1]
    unit = torch.eye(_LATENTS, _LATENTS + 10, dtype=mean.dtype, device=mean.device)
    return torch.cat([rows, unit.expand(*rows.shape[:-2], -1, -1)], dim=-2)


def _rotation_columns(problem: BoardProblem, theta: Tensor) -> Tensor:
    """R e_x, R e_y and R e_z, one after the other, ``(points, *batch, boards, 9)``, at cubature points of theta."""
    return (rotation_from_vector(theta) @ problem.rotation).mT.flatten(-2)


def _turned(problem: BoardProblem, theta: Tensor) -> Tensor:
    """Board points turned by exp(theta) R0, ``(points, *batch, boards, 3 corners)``, at cubature points of theta."""
    return (problem.body_points @ (rotation_from_vector(theta) @ problem.rotation).mT).flatten(-2)


def _scatter(matrix: Tensor) -> Tensor:
    """Rows of each board's own nine unknowns, ``(*batch, boards, rows, 10)``, as rows of the whole state's."""
    boards = matrix.shape[-3]
    own = torch.eye(boards, dtype=matrix.dtype, device=matrix.device)[:, None, :, None]
    poses = (own * matrix[..., None, :6]).flatten(-2)
    return torch.cat([poses, matrix[..., 6:]], dim=-1).flatten(-3, -2)


def _measured_model(problem: BoardProblem, mean: Tensor, factor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each corner's affine model in measured coordinates: by its board's nine unknowns, its error's factor, residual.

    Shapes ``(*batch, boards, corners, 3, 9)``, ``(.., 3, 3)`` and ``(.., 3)``.
    """
    theta, position, n = split_state(mean)
    A, b, error = slr(lambda vector: _turned(problem, vector), theta, _theta_chol(problem, factor))
    turned = (apply(A, theta) + b).unflatten(-1, (-1, 3))
    predicted = scan_position(turned + position[..., None, :], n[..., None, None, :])
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device).expand(*predicted.shape, 3)
    moves = torch.cat(
        [A.unflatten(-2, (-1, 3)), eye, -predicted[..., 1, None, None] * eye, error.unflatten(-2, (-1, 3))], dim=-1
    )
    columns = scan_position(moves.mT, n[..., None, None, None, :]).mT
    return columns[..., :9], columns[..., 9:], problem.points - predicted


def _theta_chol(problem: BoardProblem, factor: Tensor) -> Tensor:
    return lower_factor(factor[..., :-3, :].unflatten(-2, (problem.boards, 6))[..., :3, :])


def _pitch_angle(problem: BoardProblem, theta: Tensor) -> Tensor:
    """Angle of the boards' normals about the sensor axis, rad, ``(.., boards)``."""
    normal = (rotation_from_vector(theta) @ problem.rotation)[..., 2]
    return torch.atan2(-normal[..., 1], normal[..., 2])


def _pitch_row(problem: BoardProblem, pitch: MountingPitch, mean: Tensor, factor: Tensor) -> Tensor:
    """The one whitened row of a known mounting pitch of a single board, whose theta comes first in the state."""
    theta = split_state(mean)[0]
    A, b, _ = slr(lambda vector: _pitch_angle(problem, vector)[..., None], theta, _theta_chol(problem, factor))
    expected = apply(A, theta) + b
    row = torch.cat([A[..., 0, :], A.new_zeros(*A.shape[:-2], 6), pitch.angle - expected], dim=-1)
    return row / pitch.sigma
