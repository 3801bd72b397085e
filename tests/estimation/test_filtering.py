"""The filter against the exact Kalman filter, the unscented filter and itself alone."""

import math

import pytest
import torch

from lsvision.estimation import Gaussian, Info, StateSpace, filter_sequence, predict, update
from tests.estimation.models import STATE, corner, random, random_covariance, times

cholesky = torch.linalg.cholesky


def kalman(mean, P, F, Q, A, R, z):
    """Textbook prediction and update in covariance form."""
    mean, P = times(F, mean), F @ P @ F.mT + Q
    S = A @ P @ A.mT + R
    K = torch.linalg.solve(S, A @ P).mT
    return (
        mean + times(K, z - times(A, mean)),
        P - K @ S @ K.mT,
        torch.distributions.MultivariateNormal(times(A, mean), S),
    )


def unscented(f, mean, P, noise):
    """UKF(alpha = 1, beta = 0, kappa = 0), point by point: mean and covariance of f(x) + noise, cross covariance."""
    n = mean.shape[-1]
    L = cholesky(n * P)
    points = [mean + s * L[:, i] for s in (1, -1) for i in range(n)]
    values = [f(point) for point in points]
    center = sum(values) / (2 * n)
    covariance = sum(torch.outer(v - center, v - center) for v in values) / (2 * n)
    cross = sum(torch.outer(p - mean, v - center) for p, v in zip(points, values, strict=True)) / (2 * n)
    return center, covariance + noise, cross


@pytest.mark.parametrize("batch", [(), (6,)])
def test_equals_the_exact_kalman_filter_with_a_large_full_process_noise(batch):
    F, A = random(*batch, 9, 9) / 3, random(*batch, 3, 9)
    P, Q, R = random_covariance(*batch, 9), 30 * random_covariance(*batch, 9), random_covariance(*batch, 3)
    mean, z = random(*batch, 9), random(*batch, 3)
    expected_mean, expected_P, density = kalman(mean, P, F, Q, A, R, z)
    moved = predict(lambda x: times(F, x), Gaussian(mean, cholesky(P)), cholesky(Q))
    result = update(lambda x: times(A, x), moved, z, cholesky(R))
    found, chol = result.state.covariance, result.state.factor
    assert (found - expected_P).norm() / expected_P.norm() < 1e-12
    assert (result.state.mean - expected_mean).norm() / expected_mean.norm() < 1e-12
    torch.testing.assert_close(result.log_likelihood, density.log_prob(z), rtol=1e-11, atol=0)
    assert (result.info == Info.OK).all()
    assert torch.equal(chol, chol.tril())
    assert (chol.diagonal(dim1=-2, dim2=-1) > 0).all()


def test_is_the_unscented_filter_of_alpha_one():
    P, Q, R = 1e-2 * random_covariance(9), 1e-3 * random_covariance(9), random_covariance(3)
    moved = predict(lambda x: x + 0.1 * x.sin(), Gaussian(STATE, cholesky(P)), cholesky(Q))
    center, covariance, _ = unscented(lambda x: x + 0.1 * x.sin(), STATE, P, Q)
    torch.testing.assert_close(moved.mean, center, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(moved.covariance, covariance, rtol=1e-11, atol=1e-13)
    z = corner(STATE) + 1.0
    result = update(corner, moved, z, cholesky(R))
    expected, S, cross = unscented(corner, moved.mean, covariance, R)
    K = torch.linalg.solve(S, cross.mT).mT
    torch.testing.assert_close(result.state.mean, moved.mean + times(K, z - expected), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(result.state.covariance, covariance - K @ S @ K.mT, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(result.innovation, z - expected)
    torch.testing.assert_close(result.innovation_chol @ result.innovation_chol.mT, S)


def sequence(batch: tuple[int, ...], steps: int = 5):
    """Start, measurements and model of corner filters."""
    noise = torch.eye(3, dtype=torch.float64) * 0.02
    process = torch.eye(9, dtype=torch.float64) * 1e-4
    chol = torch.diag(torch.tensor([0.01] * 3 + [1.0] * 3 + [0.01] * 3, dtype=torch.float64))
    measured = corner(STATE) + 0.02 * random(steps, *batch, 3)
    start = Gaussian(STATE.expand(*batch, 9), chol.expand(*batch, 9, 9))
    return start, measured, StateSpace(lambda x, step: corner(x), noise, process)


def test_a_sequence_is_predictions_and_updates_in_turn():
    start, measured, model = sequence((3,))
    track = filter_sequence(model, start, measured)
    state, total = start, torch.zeros(3, dtype=torch.float64)
    for step, z in enumerate(measured):
        result = update(corner, predict(None, state, model.process_chol), z, model.noise_chol)
        state, total = result.state, total + result.log_likelihood
        factor = track.factors[step]
        torch.testing.assert_close(track.means[step], state.mean, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(factor @ factor.mT, state.covariance, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(track.log_likelihood, total)
    last = filter_sequence(model, start, measured, history=False)
    assert torch.equal(last.factors[-1], track.factors[-1])
    assert torch.equal(last.last.mean, track.means[-1])


def test_one_bad_problem_of_a_thousand_is_flagged_and_changes_no_bit_of_the_others():
    start, measured, model = sequence((1000,), steps=2)
    broken, singular = measured.clone(), start.factor.clone()
    broken[1, 17] = math.nan
    singular[400, 4] = 0.0
    track = filter_sequence(model, Gaussian(start.mean, singular), broken)
    assert track.info.nonzero().flatten().tolist() == [17, 400]
    assert (track.info[[17, 400]] == Info.SINGULAR).all()
    for i in (0, 16, 18, 399, 401, 999):
        own = slice(i, i + 1)
        alone = filter_sequence(model, Gaussian(start.mean[own], start.factor[own]), measured[:, own])
        assert torch.equal(alone.means[:, 0], track.means[:, i])
        assert torch.equal(alone.factors[:, 0], track.factors[:, i])


def test_a_single_problem_agrees_with_the_batch_to_rounding():
    start, measured, model = sequence((2,))
    together = filter_sequence(model, start, measured)
    alone = filter_sequence(model, Gaussian(start.mean[1], start.factor[1]), measured[:, 1])
    torch.testing.assert_close(alone.means, together.means[:, 1], rtol=1e-11, atol=1e-11)


def test_missing_measurements_leave_the_state_to_the_prediction():
    start, measured, model = sequence((2,))
    process = model.process_chol
    valid = torch.ones(5, 2, dtype=torch.bool)
    valid[2, 0] = False
    measured[2, 0] = math.nan
    track = filter_sequence(model, start, measured, valid)
    assert (track.info == Info.OK).all()
    torch.testing.assert_close(track.means[2, 0], track.means[1, 0], rtol=0, atol=1e-12)
    before, after = track.factors[1, 0], track.factors[2, 0]
    torch.testing.assert_close(after @ after.mT, before @ before.mT + process @ process.mT, rtol=1e-11, atol=1e-14)
    assert (track.whitened_innovations[2, 0] == 0).all()


def test_noise_may_change_from_step_to_step():
    state, measured, model = sequence(())
    noise, process = model.noise_chol, model.process_chol
    scales = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=torch.float64)[:, None, None]
    track = filter_sequence(StateSpace(model.h, scales * noise, scales * process), state, measured)
    for step, z in enumerate(measured):
        state = update(corner, predict(None, state, scales[step] * process), z, scales[step] * noise).state
    torch.testing.assert_close(track.means[-1], state.mean, rtol=1e-11, atol=1e-11)
