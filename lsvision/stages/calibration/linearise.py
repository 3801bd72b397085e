"""The measurement model as rows of a linear system about a Gaussian state, whitened, for the filters.

The residual of ``model`` is linear in t and n, and only θ needs cubature points. All corners of a board are predicted
by one affine map of their board points: ``linearise`` takes a board as the thirteen rows on that map's coefficients to
which ``reduction.affine_rows`` brings it, exactly, and costs the same for any number of corners. ``corner_rows`` takes
the corners one by one.

The derivative by n is the predicted travel, not the measured: the noise of y, multiplied by an n that the board cannot
show, would pass for knowledge of it.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import AffineModel, Rows, lower_factor, product, slr, upper_root
from lsvision.estimation.cubature import Function
from lsvision.geometry import scan_position
from lsvision.stages.calibration.model import pitch_angle
from lsvision.stages.calibration.problem import BoardProblem, BoardState, MountingPitch

# Sigma, rad and mm, of cubature points that stand for one point: over them the model is its tangent to ten digits.
_POINT_SIGMA = 1e-6
_LATENTS = 3  # of the error of a board's linearised rotation


def point_factor(state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch state state"]:
    """Factor of a Gaussian so narrow that linearising about it is linearising at its mean."""
    eye = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device)
    return (_POINT_SIGMA * eye).expand(*state.shape, state.shape[-1])


def linearise(
    problem: BoardProblem, mean: Float[Tensor, "*batch state"], factor: Float[Tensor, "*batch state columns"]
) -> Rows:
    """Whitened rows of all corners about a Gaussian state, at most ten per board (and one of a known mounting pitch).

    The linearisation's errors of different boards are taken as independent.
    """
    columns, reduced = affine_columns(problem, mean, factor), problem.affine_rows
    rows = product(reduced[..., :-1], columns)
    rows[..., -1] = reduced[..., -1] - rows[..., -1]
    unit = torch.eye(_LATENTS, _LATENTS + 10, dtype=mean.dtype, device=mean.device)
    triangle = upper_root(torch.cat([rows, unit.expand(*rows.shape[:-2], -1, -1)], dim=-2))
    by_latents = triangle[..., :_LATENTS, :_LATENTS].diagonal(dim1=-2, dim2=-1).abs().log().sum((-2, -1))
    by_motion = problem.valid.sum((-2, -1)) * mean[..., -2].abs().log()
    joined = _by_whole_state(triangle[..., _LATENTS:, _LATENTS:])
    if problem.pitch is not None:
        joined = torch.cat([joined, _pitch_row(problem, problem.pitch, mean, factor)], dim=-2)
    return Rows(joined, problem.noise_log_det + 2 * (by_latents + by_motion))


def corner_rows(
    problem: BoardProblem, mean: Float[Tensor, "*batch state"], factor: Float[Tensor, "*batch state columns"]
) -> Float[Tensor, "*batch boards corners 3 columns_and_one"]:
    """Whitened rows ``[A | r]`` of each corner alone, about a Gaussian state: for a filter that takes them in turn."""
    columns = _corner_columns(problem, mean, factor)
    residual = problem.points - columns[..., -1]
    columns = torch.cat([columns[..., :-1], residual[..., None]], dim=-1)
    columns = torch.linalg.solve_triangular(problem.noise_chol, columns, upper=False)
    error, rows = columns[..., :_LATENTS], columns[..., _LATENTS:]
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device).expand_as(error)
    rows = torch.linalg.solve_triangular(lower_factor(torch.cat([eye, error], dim=-1)), rows, upper=False)
    rows = torch.where(problem.valid[..., None, None], rows, 0.0)
    return _by_whole_state(rows.flatten(-3, -2)).unflatten(-2, (*problem.valid.shape[-2:], 3))


def motion_information(problem: BoardProblem, state: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch 3 3"]:
    """Fisher information of the corners on n, the poses being unknown; without any prior on n or on the poses."""
    rows = linearise(problem, state, point_factor(state)).matrix[..., :-1]
    root = upper_root(rows)[..., -3:, -3:]
    return root.mT @ root


def affine_columns(problem: BoardProblem, mean: Tensor, factor: Tensor) -> Tensor:
    """The coefficients of the boards' affine maps, ``(*batch, boards, 12, 13)``; columns as of ``_measured_columns``.

    The map from board points to measured ones is linear in t, R e_x, R e_y and R e_z.
    """
    state = BoardState.split(mean)
    turned = _regressed_by_theta(problem, mean, factor, lambda theta: problem.rotation_at(theta).mT.flatten(-2))
    placed = torch.cat([state.position[..., None, :], turned.at(state.theta).unflatten(-1, (3, 3))], dim=-2)
    by_theta = pad(_by_theta(turned), (0, 0, 0, 0, 1, 0))
    by_position = torch.zeros_like(by_theta[..., :3])
    by_position[..., 0, :, :] = torch.eye(3, dtype=mean.dtype, device=mean.device)
    return _measured_columns(placed, by_theta, by_position, state.n).flatten(-3, -2)


def _corner_columns(problem: BoardProblem, mean: Tensor, factor: Tensor) -> Tensor:
    """The predicted measurement of each corner, ``(*batch, boards, corners, 3, 13)``; columns likewise."""
    state = BoardState.split(mean)
    turned = _regressed_by_theta(
        problem, mean, factor, lambda theta: (problem.body_points @ problem.rotation_at(theta).mT).flatten(-2)
    )
    placed = turned.at(state.theta).unflatten(-1, (-1, 3)) + state.position[..., None, :]
    by_position = torch.eye(3, dtype=mean.dtype, device=mean.device).expand(*placed.shape, 3)
    return _measured_columns(placed, _by_theta(turned), by_position, state.n)


def _measured_columns(placed: Tensor, by_theta: Tensor, by_position: Tensor, n: Tensor) -> Tensor:
    """Points ``placed`` on the object and their derivatives in measured coordinates, ``(.., points, 3, 13)``.

    The columns are three latents of the linearisation's error and θ (``by_theta``), t, n, and the value.
    """
    travel = placed[..., 1] / n[..., None, None, 1]
    by_motion = -travel[..., None, None] * torch.eye(3, dtype=n.dtype, device=n.device)
    columns = torch.cat([by_theta, by_position, by_motion, placed[..., None]], dim=-1)
    return scan_position(columns.mT, n[..., None, None, None, :]).mT


def _regressed_by_theta(problem: BoardProblem, mean: Tensor, factor: Tensor, h: Function) -> AffineModel:
    """Regression of h of the boards' rotation vectors θ, over their part of a Gaussian state."""
    chol = lower_factor(factor[..., :-3, :].unflatten(-2, (problem.boards, 6))[..., :3, :])
    return slr(h, BoardState.split(mean).theta, chol)


def _by_theta(model: AffineModel) -> Tensor:
    """Latents of a regression's error, then its derivatives, by point: ``(.., points, 3, 6)``."""
    return torch.cat([model.error, model.A], dim=-1).unflatten(-2, (-1, 3))


def _by_whole_state(matrix: Tensor) -> Tensor:
    """Rows on the nine unknowns of each board, ``(*batch, boards, rows, 10)``, as rows on the whole state."""
    boards = matrix.shape[-3]
    same = torch.eye(boards, dtype=matrix.dtype, device=matrix.device)[:, None, :, None]
    poses = (same * matrix[..., None, :6]).flatten(-2)
    return torch.cat([poses, matrix[..., 6:]], dim=-1).flatten(-3, -2)


def _pitch_row(problem: BoardProblem, pitch: MountingPitch, mean: Tensor, factor: Tensor) -> Tensor:
    """The one whitened row of a known mounting pitch of a single board, whose θ comes first in the state."""
    theta = BoardState.split(mean).theta
    model = _regressed_by_theta(problem, mean, factor, lambda vector: pitch_angle(problem, vector)[..., None])
    row = torch.cat(
        [model.A[..., 0, :], model.A.new_zeros(*model.A.shape[:-2], 6), pitch.angle - model.at(theta)], dim=-1
    )
    return row / pitch.sigma
