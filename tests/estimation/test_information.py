"""Fisher information, its marginals, the Cramér-Rao bound and the directions it weighs."""

import pytest
import torch

from lsvision.estimation import cramer_rao_bound, fisher_information, marginal_information, principal_directions
from tests.estimation.models import random, random_covariance


def test_information_of_a_linear_measurement():
    A, R = random(6, 4), random_covariance(6)
    chol = torch.linalg.cholesky(R)

    def whitened(x: torch.Tensor) -> torch.Tensor:
        return torch.linalg.solve_triangular(chol, (A @ x)[:, None], upper=False)

    torch.testing.assert_close(fisher_information(whitened, random(4)), A.mT @ torch.linalg.solve(R, A))


def test_marginal_information_is_the_inverse_of_the_marginal_covariance():
    information = random_covariance(3, 7)
    expected = torch.linalg.inv(torch.linalg.inv(information)[..., -2:, -2:])
    torch.testing.assert_close(marginal_information(information, 2), expected)


def test_bound_of_millimetres_beside_radians():
    scale = torch.diag(torch.tensor([1e-6, 1.0, 1e6])).double()
    information = scale @ random_covariance(3) @ scale
    bound = cramer_rao_bound(information, torch.zeros(3, 3).double())
    torch.testing.assert_close(
        scale @ bound @ scale, torch.linalg.inv(torch.linalg.solve(scale, information) @ torch.linalg.inv(scale))
    )
    assert (cramer_rao_bound(information, information) < bound).diagonal().all()


def test_directions_come_weakest_first_with_their_share_of_the_prior():
    """Information 0, 3 and 99 prior weights: posterior sigma 1, 1/2 and 1/10 of the prior's."""
    turn = torch.linalg.qr(random(3, 3)).Q
    information = turn @ torch.diag(torch.tensor([3.0, 99.0, 0.0]).double()) @ turn.mT / 0.05**2
    posterior = torch.linalg.inv(information + torch.eye(3).double() / 0.05**2)
    weighed = principal_directions(posterior, 0.05)
    vectors = weighed.vectors
    assert weighed.share.tolist() == pytest.approx([1.0, 0.5, 0.1])
    expected = turn[:, [2, 0, 1]].mT
    torch.testing.assert_close((vectors * expected).sum(-1).abs(), torch.ones(3).double())
    assert torch.equal(weighed.weakest, vectors[0])
    assert (vectors.gather(-1, vectors.abs().argmax(-1, keepdim=True)) > 0).all()
