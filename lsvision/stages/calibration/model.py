"""The measurement model of the calibration: the residual of a corner, given its board's pose and the motion n.

A corner measured at (x, y, z), y its travel, with covariance Σ and board point p (from the centroid) has the residual

    e = (x, 0, z) + y n - (exp(θ) R0 p + t),      Cov e = M Σ Mᵀ,   M = [e_x | n | e_z].

``residuals`` is that definition. M⁻¹ is ``scan_position``, which turns a displacement of the object into one of the
measurement, so that whitened by its covariance e is

    Σ^(-1/2) M⁻¹ e = Σ^(-1/2) ((x, y, z) - scan_position(exp(θ) R0 p + t)).

``linearise`` holds the same model as rows of a linear system, for the filters.

Source: Wang et al. 2024, Eq. 10-18; M generalises its R + σ_y² n nᵀ to noise that is correlated.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import apply, product
from lsvision.geometry import displace, fit_rigid, scan_position, transform, vector_from_rotation
from lsvision.stages.calibration.problem import BoardProblem, BoardState


def predicted_points(
    problem: BoardProblem, state: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch boards corners 3"]:
    """The boards' corners on the object, exp(θ) R0 p + t, mm, where it lies when its travel is zero."""
    parts = BoardState.split(state)
    return transform(problem.rotation_at(parts.theta), parts.position, problem.body_points)


def residuals(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards corners 3"]:
    """Residuals e of all corners, mm: the measured points displaced by the motion, less the predicted ones.

    Zero where ``valid`` is false.
    """
    n = BoardState.split(state).n
    error = displace(problem.points, n[..., None, None, :]) - predicted_points(problem, state)
    return torch.where(problem.valid[..., None], error, 0.0)


def whitened_residuals(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch rows"]:
    """Residuals in sigmas: three of each corner, zero where ``valid`` is false, and one of a known mounting pitch.

    Where the corners of a board err together, thirteen of each board, of the same sum of squares.
    """
    theta = BoardState.split(state).theta
    rows = (
        residuals_in_sigmas(problem, state).flatten(-3)
        if problem.correlated is None
        else board_rows(problem, state).flatten(-2)
    )
    if problem.pitch is None:
        return rows
    return torch.cat([rows, (problem.pitch.angle - pitch_angle(problem, theta)) / problem.pitch.sigma], dim=-1)


def residuals_in_sigmas(
    problem: BoardProblem, state: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch boards corners 3"]:
    """Residuals of each corner, whitened by its own noise alone; zero where ``valid`` is false."""
    n = BoardState.split(state).n
    predicted = scan_position(predicted_points(problem, state), n[..., None, None, :])
    error = torch.linalg.solve_triangular(problem.noise_chol, (problem.points - predicted)[..., None], upper=False)
    return torch.where(problem.valid[..., None], error[..., 0], 0.0)


def squared_residuals(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards"]:
    """Sums ‖e‖², mm², over each board's corners, from seven rows of a board: e is linear in (1, p, x, y, z)."""
    parts = BoardState.split(state)
    rotation, n = problem.rotation_at(parts.theta), parts.n
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    motion = torch.stack([eye[0].expand_as(n), n, eye[2].expand_as(n)], dim=-2)[..., None, :, :]
    coefficients = torch.cat([-parts.position[..., None, :], -rotation.mT, motion.expand_as(rotation)], dim=-2)
    return product(problem.residual_rows, coefficients).square().sum((-2, -1))


def refitted(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch state"]:
    """The state of the same n and the poses that fit best under it, all corners weighed alike: those of least RMSE."""
    n = BoardState.split(state).n
    fitted = fit_rigid(problem.body_points, displace(problem.points, n[..., None, None, :]), problem.valid)
    theta = vector_from_rotation(fitted.rotation @ problem.rotation.mT)
    return BoardState(theta, fitted.translation, n).join()


def rmse(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch"]:
    """Root-mean-square residual over all corners of all boards, mm."""
    squared = squared_residuals(problem, state).sum(-1)
    return (squared / problem.valid.sum((-2, -1))).sqrt()


def rotations(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards 3 3"]:
    """Rotations R of the boards, exp(θ) R0."""
    return problem.rotation_at(BoardState.split(state).theta)


def translations(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards 3"]:
    """Translations T of the boards, mm: the origins of the board frames."""
    return BoardState.split(state).position - apply(rotations(problem, state), problem.centroid)


def pitch_angle(problem: BoardProblem, theta: Float[Tensor, "*#batch boards 3"]) -> Float[Tensor, "*batch boards"]:
    """Angles of the boards' normals about the sensor axis, rad."""
    normal = problem.rotation_at(theta)[..., 2]
    return torch.atan2(-normal[..., 1], normal[..., 2])


def board_rows(problem: BoardProblem, state: Float[Tensor, "*#batch state"]) -> Float[Tensor, "*batch boards 13"]:
    """Thirteen rows of each board, in sigmas, whose sum of squares is that of its corners' residuals.

    Through the affine map from board points to measured ones, which ``affine_rows`` are about.
    """
    parts = BoardState.split(state)
    placed = torch.cat([parts.position[..., None, :], problem.rotation_at(parts.theta).mT], dim=-2)
    coefficients = scan_position(placed, parts.n[..., None, None, :]).flatten(-2)
    rows = problem.affine_rows
    return rows[..., -1] - apply(rows[..., :-1], coefficients)
