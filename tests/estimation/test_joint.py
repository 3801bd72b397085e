"""Joint iterated update: the covariance form where linear, convergence and robustness where not."""

import math

import pytest
import torch

from lsvision.estimation import (
    Gaussian,
    Info,
    Prior,
    StateSpace,
    filter_sequence,
    iterated_update,
    measurement,
    slr,
)
from lsvision.geometry import euler_angles, rotation_from_vector
from tests.estimation.models import random, random_covariance, times

cholesky = torch.linalg.cholesky


def linear_problem(*batch: int):
    """Twenty blocks of three values of five unknowns: h, values, noise factors, prior mean and covariance."""
    A, b = random(*batch, 20, 3, 5), random(*batch, 20, 3)

    def h(x: torch.Tensor) -> torch.Tensor:
        return (A @ x[..., None, :, None])[..., 0] + b

    return h, A, b, random(*batch, 20, 3), cholesky(random_covariance(*batch, 20, 3)), random(*batch, 5)


def update(h, measured, noise_chol, prior_mean, prior_chol, valid=None, **options):
    valid = torch.ones(measured.shape[:-1], dtype=torch.bool) if valid is None else valid
    root = torch.linalg.solve_triangular(prior_chol, torch.eye(prior_mean.shape[-1]).double(), upper=False)
    linearise = measurement(h, measured, lambda mean: noise_chol, valid)
    return iterated_update(linearise, Prior(prior_mean, root), Gaussian(prior_mean, prior_chol), **options)


def covariance_form(A, b, measured, noise_chol, prior_mean, P, omega=None):
    """All measurements in one dense update: no factors, no information, no tricks."""
    A, b, z = A.flatten(0, 1), b.flatten(), measured.flatten()
    R = torch.block_diag(*(chol @ chol.mT for chol in noise_chol))
    S = A @ P @ A.mT + R + (0 if omega is None else omega)
    K = torch.linalg.solve(S, A @ P).mT
    return prior_mean + K @ (z - A @ prior_mean - b), P - K @ S @ K.mT


def test_batch_equals_loop():
    h, A, b, measured, noise, mean = linear_problem(4)
    chol = cholesky(random_covariance(4, 5))
    together = update(h, measured, noise, mean, chol)
    for i in range(4):
        alone = update(
            lambda x, i=i: (A[i] @ x[..., None, :, None])[..., 0] + b[i], measured[i], noise[i], mean[i], chol[i]
        )
        torch.testing.assert_close(alone.mean, together.mean[i], rtol=0, atol=1e-13)
        assert together.iterations[i] == alone.iterations


def test_linear_update_is_the_covariance_form_and_iterating_changes_nothing():
    h, A, b, measured, noise, mean = linear_problem()
    P = random_covariance(5)
    expected, covariance = covariance_form(A, b, measured, noise, mean, P)
    once = update(h, measured, noise, mean, cholesky(P), max_iterations=1)
    done = update(h, measured, noise, mean, cholesky(P))
    for result in (once, done):
        torch.testing.assert_close(result.mean, expected, rtol=1e-11, atol=1e-12)
        torch.testing.assert_close(result.factor @ result.factor.mT, covariance, rtol=1e-10, atol=1e-13)
    assert done.iterations == 2
    assert done.converged
    assert once.info == Info.NOT_CONVERGED


def test_the_error_of_linearisation_is_common_to_all_measurements():
    """One pass over a curved function: the dense form with the full covariance Omega between all blocks."""
    A = random(8, 3, 4)

    def h(x: torch.Tensor) -> torch.Tensor:
        return ((A @ x[..., None, :, None])[..., 0]).sin()

    mean, chol, noise = random(4), cholesky(0.1 * random_covariance(4)), cholesky(random_covariance(8, 3))
    measured = h(mean) + 0.1 * random(8, 3)
    model = slr(lambda x: h(x).flatten(-2), mean, chol)
    expected, covariance = covariance_form(
        model.A.unflatten(0, (8, 3)), model.b, measured, noise, mean, chol @ chol.mT, model.error @ model.error.mT
    )
    found = update(h, measured, noise, mean, chol, max_iterations=1)
    torch.testing.assert_close(found.mean, expected, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(found.factor @ found.factor.mT, covariance, rtol=1e-8, atol=1e-11)


def test_joint_is_sequential_where_linear_and_order_does_not_matter():
    h, A, b, measured, noise, mean = linear_problem()
    chol = cholesky(random_covariance(5))
    joint = update(h, measured, noise, mean, chol)
    for order in (torch.arange(20), torch.randperm(20)):
        model = StateSpace(
            lambda x, step, order=order: times(A[order[step]], x) + b[order[step]],
            noise[order],
            torch.zeros(5, 5, dtype=torch.float64),
        )
        track = filter_sequence(model, Gaussian(mean, chol), measured[order])
        torch.testing.assert_close(track.means[-1], joint.mean, rtol=0, atol=1e-12)
        covariance = joint.factor @ joint.factor.mT
        torch.testing.assert_close(track.factors[-1] @ track.factors[-1].mT, covariance, rtol=0, atol=1e-13)


def test_missing_measurements_are_left_out():
    h, A, b, measured, noise, mean = linear_problem()
    chol, valid = cholesky(random_covariance(5)), torch.rand(20) < 0.7
    found = update(h, torch.where(valid[:, None], measured, math.nan), noise, mean, chol, valid)
    expected, _ = covariance_form(A[valid], b[valid], measured[valid], noise[valid], mean, chol @ chol.mT)
    torch.testing.assert_close(found.mean, expected, rtol=1e-11, atol=1e-12)


def test_one_bad_problem_is_flagged_alone():
    h, _, _, measured, noise, mean = linear_problem(5)
    chol = cholesky(random_covariance(5, 5))
    good = update(h, measured, noise, mean, chol)
    measured[2, 3, 1] = math.nan
    found = update(h, measured, noise, mean, chol)
    assert found.info.tolist() == [0, 0, 2, 0, 0]
    assert not found.converged[2]
    others = [0, 1, 3, 4]
    assert torch.equal(found.mean[others], good.mean[others])
    assert torch.equal(found.factor[others], good.factor[others])


def pose_problem(nominal: torch.Tensor, truth: torch.Tensor, sigma: float):
    """Points of a board turned about a nominal rotation and moved: h of [theta, t], and exact values plus noise."""
    x, y = torch.meshgrid(torch.arange(-3.0, 4), torch.arange(-2.0, 3), indexing="ij")
    board = 30 * torch.stack([x, y, 0 * x], -1).reshape(-1, 3).double()

    def h(state: torch.Tensor) -> torch.Tensor:
        rotation = rotation_from_vector(state[..., :3]) @ nominal
        return board @ rotation.mT + state[..., None, 3:]

    measured = h(truth) + sigma * random(*truth.shape[:-1], len(board), 3)
    noise = (sigma * torch.eye(3, dtype=torch.float64)).expand(*measured.shape, 3)
    return h, measured, noise


def test_near_gimbal_lock_six_iterations_reach_1e_9():
    """Pitch 0.01 rad from 90 degrees, where Euler angles need twenty; start 0.1 rad and 5 mm off."""
    nominal = rotation_from_vector(torch.tensor([0.0, math.pi / 2 - 0.01, 0.0]).double())
    assert euler_angles(nominal)[1] == pytest.approx(math.pi / 2 - 0.01)
    truth = torch.tensor([0.1, -0.1, 0.1, 5.0, -5.0, 5.0]).double()
    h, measured, noise = pose_problem(nominal, truth, 0.02)
    chol = torch.diag(torch.tensor([0.1] * 3 + [10.0] * 3)).double()
    result = update(h, measured, noise, torch.zeros(6).double(), chol, tolerance=0.0, max_iterations=12)
    errors = (result.path - result.mean).abs().amax(-1)
    assert (errors < 1e-9).nonzero()[0].item() <= 6


def test_a_prior_of_100_mm_and_measurements_of_1e_7_never_fail():
    truth = torch.cat([0.2 * random(100, 3), 100 * random(100, 3)], dim=-1)
    h, measured, noise = pose_problem(torch.eye(3).double(), truth, 1e-7)
    chol = torch.diag(torch.tensor([0.3] * 3 + [100.0] * 3)).double().expand(100, 6, 6)
    result = update(h, measured, noise, torch.zeros(100, 6).double(), chol, tolerance=1e-6)
    assert (result.info == Info.OK).all()
    assert ((result.mean - truth)[:, 3:].abs() < 1e-7).all()


def test_damping_converges_where_full_steps_diverge():
    """Range to three beacons from far away: undamped steps from here diverge."""
    beacons = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]).double()

    def h(x: torch.Tensor) -> torch.Tensor:
        return torch.atan((x[..., None, :] - beacons).square().sum(-1, keepdim=True))

    truth, start = torch.tensor([0.3, 0.4]).double(), torch.tensor([-1.5, 2.0]).double()
    noise = torch.full((3, 1, 1), 1e-2).double()
    linearise = measurement(h, h(truth), lambda mean: noise, torch.ones(3, dtype=torch.bool))
    narrow, weak = 1e-3 * torch.eye(2).double(), 1e-3 * torch.eye(2).double()
    result = iterated_update(linearise, Prior(start, weak), Gaussian(start, narrow), max_iterations=50)
    assert result.converged
    torch.testing.assert_close(result.mean, truth, rtol=0, atol=1e-2)
