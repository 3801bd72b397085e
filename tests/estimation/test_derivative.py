"""Derivatives against forward differentiation."""

import pytest
import torch
from torch.func import jacfwd

from lsvision.estimation import jacobian


def a_bit_of_everything(x: torch.Tensor) -> torch.Tensor:
    matrix = torch.stack([x, x.square(), torch.sin(x)], dim=-1) + 3 * torch.eye(3, dtype=x.dtype)
    solved = torch.linalg.solve(matrix, torch.ones(3, dtype=x.dtype))
    length = x.square().sum().sqrt()
    return torch.stack([solved, torch.where(length > 0, x / length, x), x.abs().clamp(max=1.0)])


@pytest.mark.filterwarnings("ignore:`torch.jit.script:DeprecationWarning")  # torch's own, at its first formula
@pytest.mark.parametrize("at", [[0.3, -0.2, 1.7], [2.0, 0.1, -0.4]])
def test_agrees_with_forward_differentiation(at):
    x = torch.tensor(at, dtype=torch.float64)
    found = jacobian(a_bit_of_everything, x)
    assert found.shape == (3, 3, 3)
    assert not found.requires_grad
    torch.testing.assert_close(found, jacfwd(a_bit_of_everything)(x), rtol=1e-12, atol=1e-14)


def test_what_is_not_used_does_not_count():
    """Values that are masked out may be infinite, as may be their derivatives."""
    divisor = torch.tensor([0.0, 2.0, torch.nan], dtype=torch.float64)

    def masked(x):
        return torch.where(divisor == 2.0, x.square().sqrt() / divisor, 7.0)

    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[1, 1] = 0.5
    assert torch.equal(jacobian(masked, torch.tensor([0.0, 3.0, 1.0], dtype=torch.float64)), expected)


def test_values_that_do_not_depend_on_the_argument():
    x = torch.rand(4, dtype=torch.float64)
    assert torch.equal(jacobian(lambda _: torch.ones(2, 3), x), torch.zeros(2, 3, 4))
    first_alone = jacobian(lambda move: torch.stack([move[0], torch.ones_like(move[0])]), x)
    assert torch.equal(first_alone, torch.eye(4)[:1].double().expand(2, -1) * torch.tensor([[1.0], [0.0]]))
    assert torch.equal(jacobian(lambda move: 2 * move, x), 2 * torch.eye(4).double())


def test_within_code_that_keeps_no_gradients():
    x = torch.rand(3, dtype=torch.float64)
    for context in (torch.no_grad(), torch.inference_mode()):
        with context:
            found = jacobian(torch.square, x)
        torch.testing.assert_close(found, 2 * x.diag())
