"""What corners say of poses and n: derivatives, noise, information."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from lsvision.estimation import fisher_information, jacobian, marginal_information
from lsvision.geometry import displace
from lsvision.stages.calibration.model import (
    MountingPitch,
    corner_rows,
    linearise,
    motion_information,
    nominal_problem,
    rotations,
    split_state,
    squared_residuals,
    translations,
    whitened_residuals,
)
from tests.stages.calibration.boards import SIGMA, simulate


def residuals(corners, problem, state):
    """Displaced measurements less the board."""
    moved = displace(corners.points, split_state(state)[2][..., None, None, :])
    return moved - (corners.board_points @ rotations(problem, state).mT + translations(problem, state)[..., None, :])


def spread(sigma: float, size: int) -> torch.Tensor:
    return sigma * torch.eye(size, dtype=torch.float64)


def test_start_is_the_best_fit_without_motion_correction_and_poses_are_told_apart():
    corners = simulate(sigma=(0.0, 0.0, 0.0), n=torch.tensor([0.0, 1.0, 0.0]).double())
    problem, start = corners.problem()
    assert squared_residuals(problem, start).max() < 1e-16
    torch.testing.assert_close(rotations(problem, start), corners.rotation)
    torch.testing.assert_close(translations(problem, start), corners.translation)
    assert split_state(start)[2].tolist() == [0.0, 1.0, 0.0]


def test_rows_tend_to_the_derivative_with_the_square_of_sigma():
    """max |A - jacfwd(h)| of all corners falls by 100 for every factor 10 in sigma, from 0.1 to 1e-4.

    The noise is so large here that the linearisation's own error has no weight in the rows' whitening.
    """
    problem, start = simulate().problem()
    problem = replace(problem, noise_chol=1e5 * problem.noise_chol)
    state = start + 0.05 * torch.randn_like(start)
    derivative = -jacobian(lambda x: whitened_residuals(problem, x), state)
    errors = []
    for sigma in (1e-1, 1e-2, 1e-3, 1e-4):
        rows = corner_rows(problem, state, spread(sigma, 21)).flatten(0, 2)
        errors.append((rows[:, :-1] - derivative).abs().max().item())
    for wide, narrow in itertools.pairwise(errors):
        assert wide / narrow == pytest.approx(100.0, rel=0.2)


def test_compressed_rows_hold_all_that_the_corners_say():
    problem, start = simulate().problem()
    J, r = jacobian(lambda x: whitened_residuals(problem, x), start), whitened_residuals(problem, start)
    rows = linearise(problem, start, spread(1e-6, 21)).matrix
    assert rows.shape == (30, 22)
    whole = torch.cat([-J, r[:, None]], dim=-1)
    torch.testing.assert_close(rows.mT @ rows, whole.mT @ whole, rtol=1e-6, atol=1e-3)


def test_noise_is_that_of_the_residual_re_evaluated_at_n():
    """Cov e = M Σ Mᵀ with M = [e_x | n | e_z]; for independent noise R + σ_y² n nᵀ."""
    corners = simulate([(5.0, 3.0, 1.0)])
    problem, start = corners.problem()
    e, white = residuals(corners, problem, start)[0], whitened_residuals(problem, start).reshape(-1, 3)
    n = split_state(start)[2]
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
    masked, short = (linearise(p, start, spread(1e-3, 21).expand(2, 21, 21)) for p in (problem, fewer))
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
    row = linearise(problem, start, spread(1e-5, 9)).matrix[-1]
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
        row = linearise(problem, state, spread(sigma, 9)).matrix[-1]
        errors.append((row[:-1] - derivative).abs().max().item())
    for wide, narrow in itertools.pairwise(errors):
        assert wide / narrow == pytest.approx(100.0, rel=0.2)


def test_squared_residuals_are_those_of_displaced_measurements_less_the_board():
    corners = simulate(batch=(2,))
    problem, start = corners.problem()
    expected = residuals(corners, problem, start)
    torch.testing.assert_close(squared_residuals(problem, start), expected.square().sum((-2, -1)), rtol=1e-10, atol=0)
