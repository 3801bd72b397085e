"""Linear algebra of batches: LAPACK one matrix at a time, and the same bits alone and in a batch."""

import pytest
import torch

from lsvision.estimation.linalg import (
    absorb,
    apply,
    forward_substitute,
    lower_factor,
    ordered_sum,
    product,
    solve_upper,
    upper_root,
)
from tests.estimation.models import random, random_covariance, times


def batch_last(matrix: torch.Tensor) -> torch.Tensor:
    return matrix.movedim((-2, -1), (0, 1)).contiguous()


@pytest.mark.parametrize("batch", [(), (1,), (7,), (300,), (4, 5)])
def test_absorbing_keeps_the_sum_of_squares(batch):
    """[L; 0] of two columns takes up five columns of four rows: L' is the Cholesky factor's first two columns."""
    L = torch.linalg.cholesky(random_covariance(*batch, 2))
    top, bottom = random(*batch, 2, 5), random(*batch, 2, 5)
    found, rest = absorb(batch_last(L), batch_last(top), batch_last(bottom))
    whole = torch.cat([torch.cat([L, torch.zeros_like(L)], -2), torch.cat([top, bottom], -2)], -1)
    expected = torch.linalg.cholesky(whole @ whole.mT)
    found, rest = (part.movedim((0, 1), (-2, -1)) for part in (found, rest))
    torch.testing.assert_close(found, expected[..., :2], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(rest @ rest.mT, (expected @ expected.mT - found @ found.mT)[..., 2:, 2:])


def test_batch_equals_loop_bit_for_bit():
    L, E = batch_last(torch.linalg.cholesky(random_covariance(100, 6))), random(6, 9, 100)
    together, _ = absorb(L, E)
    for size in (1, 3, 33):
        assert torch.equal(absorb(L[..., :size], E[..., :size])[0], together[..., :size])


def test_a_zero_row_is_singular_and_stays_alone():
    E = random(3, 4, 2)
    E[1, :, 0] = 0.0
    found, _ = absorb(torch.zeros(3, 3, 2, dtype=torch.float64), E)
    assert found[..., 0].isnan().any()
    assert found[..., 1].isfinite().all()
    assert absorb(torch.zeros(3, 3, dtype=torch.float64), E[..., 0])[0].isnan().any()


def test_tiny_noise_beside_a_wide_prior_keeps_its_digits():
    """1e-7 beside 100: a difference of squares would lose the small one whole."""
    L, E = torch.tensor([[1e-7]]).double(), torch.tensor([[100.0], [100.0]]).double()
    _, rest = absorb(L, E)
    assert rest.abs().item() == pytest.approx(1e-7, rel=1e-9)


def test_forward_substitution():
    L, right = torch.linalg.cholesky(random_covariance(5, 4)), random(5, 4, 2)
    found = forward_substitute(batch_last(L), batch_last(right))
    torch.testing.assert_close(found.movedim(-1, 0), torch.linalg.solve_triangular(L, right, upper=False))
    torch.testing.assert_close(forward_substitute(L[0], right[0]), found[..., 0])


def test_ordered_sum_is_a_sum():
    terms = random(3, 9, 10)
    torch.testing.assert_close(ordered_sum(terms)[:, 0], terms.sum(1))


def test_lapack_roots_do_not_depend_on_the_batch():
    matrix = random(9, 21, 13)
    root, lower = upper_root(matrix), lower_factor(matrix.mT)
    torch.testing.assert_close(root.mT @ root, matrix.mT @ matrix)
    torch.testing.assert_close(lower, torch.linalg.cholesky(matrix.mT @ matrix))
    eye = torch.eye(13, dtype=torch.float64)
    inverse = solve_upper(root, eye.expand(9, 13, 13))
    torch.testing.assert_close(root @ inverse, eye.expand(9, 13, 13))
    for i in range(9):
        alone = matrix[i].clone()
        assert torch.equal(upper_root(alone), root[i])
        assert torch.equal(solve_upper(upper_root(alone), eye), inverse[i])


def test_products_are_products_and_do_not_depend_on_the_batch():
    left, right, vector = random(9, 5, 13), random(9, 13, 4), random(9, 13)
    whole, applied = product(left, right), apply(left, vector)
    torch.testing.assert_close(whole, left @ right)
    torch.testing.assert_close(applied, times(left, vector))
    for i in range(9):
        assert torch.equal(product(left[i].clone(), right[i].clone()), whole[i])
        assert torch.equal(apply(left[i].clone(), vector[i].clone()), applied[i])
