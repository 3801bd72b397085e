"""The measurement model: residuals against their definition, derivatives, noise, information."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from lsvision.estimation import fisher_information, jacobian, marginal_information
from lsvision.geometry import displace
from lsvision.stages.calibration.linearise import corner_rows, linearise, motion_information
from lsvision.stages.calibration.model import (
    residuals,
    rotations,
    squared_residuals,
    translations,
    whitened_residuals,
)
from lsvision.stages.calibration.problem import BoardState, MountingPitch, nominal_problem
from tests.stages.calibration.boards import SIGMA, simulate


def naive_residuals(corners, problem, state):
    """Displaced measurements less the board."""
    moved = displace(corners.points, BoardState.split(state).n[..., None, None, :])
    return moved - (corners.board_points @ rotations(problem, state).mT + translations(problem, state)[..., None, :])


def factor(sigma: float, size: int) -> torch.Tensor:
    return sigma * torch.eye(size, dtype=torch.float64)


def test_start_is_the_best_fit_without_motion_correction_and_poses_are_separate():
    corners = simulate(sigma=(0.0, 0.0, 0.0), n=torch.tensor([0.0, 1.0, 0.0]).double())
    problem, start = corners.problem()
    assert squared_residuals(problem, start).max() < 1e-16
    torch.testing.assert_close(rotations(problem, start), corners.rotation)
    torch.testing.assert_close(translations(problem, start), corners.translation)
    assert BoardState.split(start).n.tolist() == [0.0, 1.0, 0.0]


def test_rows_tend_to_the_derivative_with_the_square_of_sigma():
    """max |A - jacfwd(h)| of all corners falls by 100 for every factor 10 in sigma, from 0.1 to 1e-4.

    The noise is so large here that the linearisation's error has no weight in the rows' whitening.
    """
    problem, start = simulate().problem()
    problem = replace(problem, noise_chol=1e5 * problem.noise_chol)
    state = start + 0.05 * torch.randn_like(start)
    derivative = -jacobian(lambda x: whitened_residuals(problem, x), state)
    errors = []
    for sigma in (1e-1, 1e-2, 1e-3, 1e-4):
        rows = corner_rows(problem, state, factor(sigma, 21)).flatten(0, 2)
        errors.append((rows[:, :-1] - derivative).abs().max().item())
    for wide, narrow in itertools.pairwise(errors):
        assert wide / narrow == pytest.approx(100.0, rel=0.2)


def test_compressed_rows_hold_all_that_the_corners_say():
    problem, start = simulate().problem()
    J, r = jacobian(lambda x: whitened_residuals(problem, x), start), whitened_residuals(problem, start)
    rows = linearise(problem, start, factor(1e-6, 21)).matrix
    assert rows.shape == (30, 22)
    whole = torch.cat([-J, r[:, None]], dim=-1)
    torch.testing.assert_close(rows.mT @ rows, whole.mT @ whole, rtol=1e-6, atol=1e-3)


def test_noise_is_that_of_the_residual_re_evaluated_at_n():
    """Cov e = M Σ Mᵀ with M = [e_x | n | e_z]; for independent noise R + σ_y² n nᵀ."""
    corners = simulate([(5.0, 3.0, 1.0)])
    problem, start = corners.problem()
    e, white = naive_residuals(corners, problem, start)[0], whitened_residuals(problem, start).reshape(-1, 3)
    n = BoardState.split(start).n
    M = torch.eye(3, dtype=torch.float64)
    M[:, 1] = n
    covariance = M @ corners.covariance[0] @ M.mT
    x2, y2, z2 = (s * s for s in SIGMA)
    expected = torch.diag(torch.tensor([x2, 0.0, z2]).double()) + y2 * torch.outer(n, n)
    torch.testing.assert_close(covariance[0], expected)
    norm = (e * torch.linalg.solve(covariance, e)).sum(-1)
    torch.testing.assert_close(white.square().sum(-1), norm)


def test_a_board_alone_says_nothing_of_one_direction_however_noisy():
    """The derivative by n is the predicted travel: the measured one's noise would pass for information."""
    corners = simulate([(5.0, 0.0, 0.0)], sigma=(0.02, 0.5, 0.014))
    problem, start = corners.problem()
    weight = torch.linalg.eigvalsh(motion_information(problem, start)) * 0.05**2
    assert weight[0].abs() < 1e-6
    assert weight[1] > 1e3


def test_information_is_fishers_of_the_exact_likelihood_with_the_poses_unknown():
    problem, start = simulate().problem()
    whole = fisher_information(lambda x: whitened_residuals(problem, x), start)
    torch.testing.assert_close(motion_information(problem, start), marginal_information(whole, 3), rtol=1e-5, atol=1.0)


def test_missing_corners_weigh_nothing():
    corners = simulate(batch=(2,))
    seen = corners.valid.clone()
    seen[..., ::3] = False
    points = torch.where(seen[..., None], corners.points, 0.0)
    chol = torch.linalg.cholesky(corners.covariance)
    problem, start = nominal_problem(points, chol, corners.board_points, seen)
    kept = seen[0, 0]
    fewer, fewer_start = nominal_problem(
        points[..., kept, :], chol[..., kept, :, :], corners.board_points[..., kept, :], seen[..., kept]
    )
    torch.testing.assert_close(fewer_start, start)
    masked, short = (linearise(p, start, factor(1e-3, 21).expand(2, 21, 21)) for p in (problem, fewer))
    torch.testing.assert_close(masked.matrix.mT @ masked.matrix, short.matrix.mT @ short.matrix, rtol=1e-9, atol=1e-4)
    torch.testing.assert_close(masked.log_det, short.log_det)


def test_known_pitch_adds_one_row():
    corners = simulate([(7.0, 0.0, 0.0)])
    problem, start = nominal_problem(
        corners.points,
        torch.linalg.cholesky(corners.covariance),
        corners.board_points,
        corners.valid,
        MountingPitch(math.radians(7.0), 1e-3),
    )
    plain, _ = corners.problem()
    J = jacobian(lambda x: whitened_residuals(problem, x), start)[-1]
    row = linearise(problem, start, factor(1e-5, 9)).matrix[-1]
    torch.testing.assert_close(row[:-1], -J, rtol=1e-6, atol=1e-6)
    assert row[-1] == pytest.approx(whitened_residuals(problem, start)[-1].item(), rel=1e-6)
    assert whitened_residuals(plain, start).shape[-1] == whitened_residuals(problem, start).shape[-1] - 1
    assert torch.linalg.eigvalsh(motion_information(problem, start))[0] * 0.05**2 > 100


def test_pitch_row_tends_to_the_derivative_with_the_square_of_sigma():
    corners = simulate([(7.0, 3.0, 0.0)])
    known = MountingPitch(math.radians(7.0), 1.0)
    chol = torch.linalg.cholesky(corners.covariance)
    problem, start = nominal_problem(corners.points, chol, corners.board_points, corners.valid, known)
    state = start + 0.05 * torch.randn_like(start)
    derivative = -jacobian(lambda x: whitened_residuals(problem, x), state)[-1]
    errors = []
    for sigma in (1e-1, 1e-2, 1e-3, 1e-4):
        row = linearise(problem, state, factor(sigma, 9)).matrix[-1]
        errors.append((row[:-1] - derivative).abs().max().item())
    for wide, narrow in itertools.pairwise(errors):
        assert wide / narrow == pytest.approx(100.0, rel=0.2)


def scattered(problem, start):
    """A problem of two batches with every fourth corner not seen, and states off its start."""
    valid = torch.arange(problem.valid.shape[-1]) % 4 != 0
    problem = replace(problem, valid=problem.valid & valid, points=torch.where(valid[:, None], problem.points, 0.0))
    return problem, start + 0.05 * torch.randn_like(start)


def test_residuals_are_displaced_measurements_less_the_board():
    corners = simulate(batch=(2,))
    problem, state = scattered(*corners.problem())
    expected = torch.where(problem.valid[..., None], naive_residuals(corners, problem, state), 0.0)
    torch.testing.assert_close(residuals(problem, state), expected, rtol=1e-10, atol=1e-10)


def test_squared_residuals_are_those_of_displaced_measurements_less_the_board():
    corners = simulate(batch=(2,))
    problem, start = corners.problem()
    expected = naive_residuals(corners, problem, start)
    torch.testing.assert_close(squared_residuals(problem, start), expected.square().sum((-2, -1)), rtol=1e-10, atol=0)


def test_seven_rows_of_a_board_hold_its_squared_residuals_anywhere():
    problem, state = scattered(*simulate(batch=(2,)).problem())
    expected = residuals(problem, state).square().sum((-2, -1))
    torch.testing.assert_close(squared_residuals(problem, state), expected, rtol=1e-10, atol=0)


def test_whitened_residuals_are_those_divided_by_their_covariance():
    """Sum of squares = Σ eᵀ (M Σ Mᵀ)⁻¹ e, M = [e_x | n | e_z], for noise that is correlated."""
    corners = simulate(batch=(2,))
    mixed = torch.linalg.cholesky(corners.covariance + 1e-4 * torch.ones(3, 3).double())
    problem, start = corners.problem()
    problem, state = scattered(replace(problem, noise_chol=mixed), start)
    M = torch.eye(3).double().repeat(2, 1, 1, 1, 1)
    M[..., 1] = BoardState.split(state).n[:, None, None, :]
    e, covariance = residuals(problem, state), M @ mixed @ mixed.mT @ M.mT
    expected = (e * torch.linalg.solve(covariance, e)).sum((-3, -2, -1))
    torch.testing.assert_close(whitened_residuals(problem, state).square().sum(-1), expected, rtol=1e-10, atol=0)


def test_thirteen_rows_of_a_board_hold_its_whitened_errors_under_any_affine_map():
    """‖q - S c‖² = Σ ‖Σ^(-1/2) (measured - c_0 - C p)‖², corner by corner."""
    problem, _ = scattered(*simulate(batch=(2,)).problem())
    offset, C = 5 * torch.randn(2, 3, 3).double(), torch.randn(2, 3, 3, 3).double()
    error = problem.points - offset[..., None, :] - problem.body_points @ C.mT
    white = torch.linalg.solve_triangular(problem.noise_chol, error[..., None], upper=False)[..., 0]
    expected = torch.where(problem.valid[..., None], white, 0.0).square().sum((-2, -1))
    coefficients = torch.cat([offset, C.mT.flatten(-2)], dim=-1)
    rows = problem.affine_rows
    found = rows[..., -1] - (rows[..., :-1] @ coefficients[..., None])[..., 0]
    torch.testing.assert_close(found.square().sum(-1), expected, rtol=1e-10, atol=0)


def test_a_linearised_board_is_its_corners_one_by_one():
    """Without error of the linearisation the compressed rows and those of all corners have one normal equation."""
    problem, state = scattered(*simulate().problem())
    compressed = linearise(problem, state, factor(1e-6, 21)).matrix
    corner = corner_rows(problem, state, factor(1e-6, 21)).flatten(0, 2)
    expected = corner.mT @ corner
    scale = expected.diagonal().sqrt()
    difference = (compressed.mT @ compressed - expected) / (scale[:, None] * scale)
    assert difference.abs().max() < 1e-10
