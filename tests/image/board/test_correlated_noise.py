"""The gain of correlated residuals against a loop over fits, blocks and parameters, and against noise that is known."""

import pytest
import torch
from torch import Tensor

from lsvision.image.board.correlated_noise import correlation_gain

WANTED = slice(0, 2)


def slow_gain(jacobian: Tensor, inverse_normal: Tensor, residual: Tensor, variance: Tensor, block: int) -> Tensor:
    """Gain of one fit by blocks of ``block x block`` cells, sum by sum; a cell is an eighth of the window."""
    size = round(len(residual) ** 0.5)
    cell = max(round(size / 8), 1)
    cells = -(-size // cell)
    influence = inverse_normal[WANTED] @ jacobian
    observed = taken = torch.tensor(0.0).double()
    for top in range(1 - block, cells):
        for left in range(1 - block, cells):
            v, u = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
            rows = (v >= top * cell) & (v < (top + block) * cell)
            here = (rows & (u >= left * cell) & (u < (left + block) * cell)).flatten()
            for pull in influence:
                observed = observed + (pull * residual)[here].sum().square()
                share = (jacobian * pull)[:, here].sum(-1)
                taken = taken + share @ inverse_normal @ share
    return observed / (variance * (block**2 * influence.square().sum() - taken))


@pytest.mark.parametrize("size", [6, 17, 27])
def test_equals_a_loop(size):
    jacobian = torch.randn(3, 5, size**2, dtype=torch.float64)
    jacobian[:, :, torch.rand(size**2) < 0.2] = 0.0
    residual = torch.randn(3, size**2, dtype=torch.float64)
    inverse_normal = torch.linalg.inv(jacobian @ jacobian.mT)
    variance = residual.square().mean(-1)
    gain = correlation_gain(jacobian, inverse_normal, WANTED, residual, variance)
    for i in range(3):
        fit = jacobian[i], inverse_normal[i], residual[i], variance[i]
        torch.testing.assert_close(gain[i], 2 * slow_gain(*fit, block=4) - slow_gain(*fit, block=2))


def test_independent_noise_has_a_gain_of_one():
    jacobian = torch.randn(4, 17**2, dtype=torch.float64)
    inverse_normal = torch.linalg.inv(jacobian @ jacobian.mT)
    noise = torch.randn(4000, 17**2, dtype=torch.float64)
    residual = noise - noise @ jacobian.mT @ inverse_normal @ jacobian
    variance = residual.square().sum(-1) / (17**2 - 4)
    batch = len(noise)
    gain = correlation_gain(
        jacobian.expand(batch, -1, -1), inverse_normal.expand(batch, -1, -1), WANTED, residual, variance
    )
    assert abs(gain.mean() - 1) < 0.03


def test_residuals_of_zero_have_no_gain():
    jacobian = torch.randn(1, 4, 81, dtype=torch.float64)
    inverse_normal = torch.linalg.inv(jacobian @ jacobian.mT)
    zero = torch.zeros(1, 81).double()
    assert correlation_gain(jacobian, inverse_normal, WANTED, zero, zero[:, 0]).tolist() == [0.0]
