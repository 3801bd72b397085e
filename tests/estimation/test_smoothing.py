"""Smoother against the joint Gaussian of the whole sequence."""

import pytest
import torch

from lsvision.estimation import Gaussian, StateSpace, filter_sequence, smooth
from tests.estimation.models import random, random_covariance, times

cholesky = torch.linalg.cholesky


def linear_track(transition, batch=(), steps=6):
    A, z = random(steps, *batch, 2, 3), random(steps, *batch, 2)
    mean, P, Q, R = random(*batch, 3), random_covariance(*batch, 3), random_covariance(*batch, 3), random_covariance(2)
    f = None if transition is None else lambda x: times(transition, x)
    model = StateSpace(lambda x, k: times(A[k], x), cholesky(R), cholesky(Q), f)
    return filter_sequence(model, Gaussian(mean, cholesky(P)), z), model, (A, z, mean, P, Q, R)


def whole_sequence(A, z, mean, P, Q, R, F):
    """Means and covariances of all states, from the one dense Gaussian of all states and measurements."""
    steps, n = len(A), 3
    moves = [torch.linalg.matrix_power(F, k) for k in range(steps + 1)]
    prior_mean = torch.cat([moves[k + 1] @ mean for k in range(steps)])
    prior = torch.zeros(steps * n, steps * n).double()
    for i in range(steps):
        for j in range(steps):
            block = moves[i + 1] @ P @ moves[j + 1].mT
            block = block + sum(moves[i - k] @ Q @ moves[j - k].mT for k in range(min(i, j) + 1))
            prior[i * n : (i + 1) * n, j * n : (j + 1) * n] = block
    H, noise = torch.block_diag(*A), torch.block_diag(*[R] * steps)
    S = H @ prior @ H.mT + noise
    K = torch.linalg.solve(S, H @ prior).mT
    covariance = prior - K @ S @ K.mT
    means = (prior_mean + K @ (z.flatten() - H @ prior_mean)).unflatten(0, (steps, n))
    return means, torch.stack([covariance[k * n : k * n + n, k * n : k * n + n] for k in range(steps)])


@pytest.mark.parametrize("walk", [True, False])
def test_equals_the_dense_gaussian_of_the_whole_sequence(walk):
    F = torch.eye(3).double() if walk else random(3, 3) / 2
    track, model, problem = linear_track(None if walk else F)
    found = smooth(track, model)
    expected_means, expected = whole_sequence(*problem, F)
    torch.testing.assert_close(found.mean, expected_means, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found.covariance, expected, rtol=1e-9, atol=1e-11)


def test_batch_equals_loop():
    track, model, (A, z, mean, P, _, R) = linear_track(random(3, 3) / 2, batch=(4,))
    means = smooth(track, model).mean
    single = StateSpace(lambda x, k: times(A[k, 2], x), cholesky(R), model.process_chol[2], model.f)
    alone = filter_sequence(single, Gaussian(mean[2], cholesky(P[2])), z[:, 2])
    torch.testing.assert_close(smooth(alone, single).mean, means[:, 2], rtol=1e-11, atol=1e-11)


def test_the_last_state_is_the_filtered_one_and_the_others_are_surer():
    track, model, _ = linear_track(None)
    found = smooth(track, model)
    assert torch.equal(found.mean[-1], track.means[-1])
    filtered, smoothed = (part.square().sum((-2, -1)) for part in (track.factors, found.factor))
    assert (smoothed[:-1] < filtered[:-1]).all()


def test_needs_the_history():
    eye = torch.eye(2).double()
    model = StateSpace(lambda x, _: x, eye, eye)
    track = filter_sequence(model, Gaussian(random(2), eye), random(3, 2), history=False)
    with pytest.raises(ValueError, match="factor for each of 3 steps"):
        smooth(track, model)
