"""Re-centring a rotation vector: the same rotation, and the same Gaussian of rotations."""

import torch

from lsvision.estimation import Gaussian, jacobian, recentre
from lsvision.geometry import rotation_from_vector, vector_from_rotation
from tests.estimation.models import random, random_covariance


def test_keeps_rotation_and_gaussian():
    nominal, mean = rotation_from_vector(random(4, 3)), random(4, 8)
    chol = torch.linalg.cholesky(random_covariance(4, 8))
    rotation, centred = recentre(nominal, Gaussian(mean, chol), first=2)
    factor = centred.factor
    torch.testing.assert_close(rotation, rotation_from_vector(mean[:, 2:5]) @ nominal)
    assert (centred.mean[:, 2:5] == 0).all()
    assert torch.equal(centred.mean[:, [0, 1, 5, 6, 7]], mean[:, [0, 1, 5, 6, 7]])
    assert torch.equal(factor, factor.tril())
    for i in range(4):

        def about_new(theta: torch.Tensor, i: int = i) -> torch.Tensor:
            return vector_from_rotation(rotation_from_vector(theta) @ nominal[i] @ rotation[i].mT)

        reset = torch.eye(8).double()
        reset[2:5, 2:5] = jacobian(about_new, mean[i, 2:5] + 1e-9)
        expected = reset @ chol[i] @ chol[i].mT @ reset.mT
        torch.testing.assert_close(factor[i] @ factor[i].mT, expected, rtol=1e-6, atol=1e-6)


def test_batch_equals_loop():
    nominal, mean = rotation_from_vector(random(5, 3)), random(5, 6)
    chol = torch.linalg.cholesky(random_covariance(5, 6))
    rotation, state = recentre(nominal, Gaussian(mean, chol), first=0)
    for i in range(5):
        own_rotation, own_state = recentre(nominal[i], Gaussian(mean[i], chol[i]), first=0)
        torch.testing.assert_close(own_rotation, rotation[i], rtol=0, atol=1e-14)
        torch.testing.assert_close(own_state.mean, state.mean[i], rtol=0, atol=1e-14)
        torch.testing.assert_close(own_state.factor, state.factor[i], rtol=0, atol=1e-14)
