"""The band of the gains' normal equations against least squares with every unknown written out."""

import pytest
import torch

from lsvision.stages.response.gain_equations import GainEquations

WIDTH = 12


def seen(seed: int, wander: list[float]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sums of logarithms of two colours, their weights, and wanders."""
    chance = torch.Generator().manual_seed(seed)
    weight = torch.randint(0, 5, (len(wander), WIDTH), generator=chance).double()
    sums = weight[..., None] * torch.randn(len(wander), WIDTH, 2, generator=chance, dtype=torch.float64)
    return sums, weight, torch.tensor(wander, dtype=torch.float64)


def written_out(sums: torch.Tensor, weight: torch.Tensor, wander: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrix and right side: diag(w) - Gᵀ K⁻¹ G with a row for every column of the pattern."""
    margin = 10
    to_pattern = torch.zeros(len(wander), WIDTH + 2 * margin, WIDTH, dtype=torch.float64)
    for place, by in enumerate(wander.tolist()):
        for column in range(WIDTH):
            at = column - by + margin
            base = int(at // 1)
            to_pattern[place, base, column] += 1 - (at - base)
            to_pattern[place, base + 1, column] += at - base
    gathered = (to_pattern * weight[:, None]).sum(0)
    inverse = torch.diag(1 / gathered.sum(1).clamp(min=1e-9))
    shown = torch.einsum("pxu,puc->xc", to_pattern, sums)
    matrix = torch.diag(weight.sum(0)) - gathered.mT @ inverse @ gathered
    return matrix, sums.sum(0) - gathered.mT @ inverse @ shown


@pytest.mark.parametrize("wander", [[0.0], [0.5], [-1.5, 0.0, 2.0], [-4.0, -3.5, 3.0, 3.5, 5.0]])
def test_the_band_is_the_matrix(wander):
    data = seen(0, wander)
    found, (matrix, right) = GainEquations.of_segment(*data), written_out(*data)
    torch.testing.assert_close(found.applied(torch.eye(WIDTH).double()), matrix, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.right, right, rtol=0, atol=1e-12)


def test_segments_add_up_whatever_their_wander():
    near, far = seen(1, [0.0, 0.5]), seen(2, [-6.0, 0.0, 3.5])
    both = GainEquations.of_segment(*near) + GainEquations.of_segment(*far)
    matrix = written_out(*near)[0] + written_out(*far)[0]
    torch.testing.assert_close(both.applied(torch.eye(WIDTH).double()), matrix, rtol=0, atol=1e-12)
    assert torch.equal(both.places, (near[1] > 0).sum(0).double() + (far[1] > 0).sum(0))


def test_gains_are_least_squares_where_wander_shows_them():
    sums, weight, wander = seen(3, [-2.0, -1.0, -0.5, 0.0, 1.0, 1.5, 3.0])
    found = GainEquations.of_segment(sums, weight + 1, wander)
    matrix, right = written_out(sums, weight + 1, wander)
    expected = torch.linalg.lstsq(matrix, right, driver="gelsd").solution
    solved = found.solved()
    torch.testing.assert_close(solved - solved.mean(0), expected - expected.mean(0), rtol=0, atol=1e-6)
