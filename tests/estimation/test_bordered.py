"""Shared and own unknowns at once: the oracle is least squares over all of them as one vector."""

import pytest
import torch

from lsvision.estimation import (
    BorderedState,
    block_rows,
    bordered_least_squares,
    levenberg_marquardt,
    shared_information,
)

BLOCKS, ROWS, SHARED, OWN = 5, 12, 3, 2


def problem(*batch: int):
    """Residuals that are curved in both kinds of unknowns."""
    A = torch.randn(*batch, BLOCKS, ROWS, SHARED + OWN, dtype=torch.float64)
    right = torch.randn(*batch, BLOCKS, ROWS, dtype=torch.float64)

    def residual(state: BorderedState) -> torch.Tensor:
        shared = state.shared[..., None, :].expand(*state.own.shape[:-1], SHARED)
        both = torch.cat([shared, state.own], dim=-1)
        return (A * (both + 0.1 * both.square())[..., None, :]).sum(-1) - right

    start = BorderedState(torch.zeros(*batch, SHARED).double(), torch.zeros(*batch, BLOCKS, OWN).double())
    return residual, start


def as_one(residual):
    """The same with all unknowns in one vector, and the prior's rows."""

    def rows(state):
        shared, own = state.split([SHARED, BLOCKS * OWN], dim=-1)
        values = residual(BorderedState(shared, own.unflatten(-1, (BLOCKS, OWN))))
        return torch.cat([values.flatten(-2), shared], dim=-1)

    return rows


def test_minimum_and_covariance_are_those_of_one_vector():
    residual, start = problem()
    found = bordered_least_squares(residual, start, tolerance=1e-8)
    oracle = levenberg_marquardt(as_one(residual), torch.zeros(SHARED + BLOCKS * OWN).double(), tolerance=1e-9)
    assert bool(found.converged)
    both = torch.cat([found.state.shared, found.state.own.flatten()])
    assert torch.allclose(both, oracle.state, rtol=0, atol=1e-7)
    covariance = (oracle.factor @ oracle.factor.mT)[:SHARED, :SHARED]
    assert torch.allclose(found.factor @ found.factor.mT, covariance, rtol=1e-6, atol=0)


def test_rows_are_derivatives_and_residuals():
    residual, start = problem()
    rows = block_rows(residual, start)
    torch.testing.assert_close(rows[..., -1], residual(start))
    for column in range(OWN + SHARED):
        step = torch.zeros(OWN + SHARED).double()
        step[column] = 1e-6
        moved = BorderedState(start.shared + step[OWN:], start.own + step[:OWN])
        torch.testing.assert_close(rows[..., column], (residual(moved) - residual(start)) / 1e-6, rtol=0, atol=1e-5)


def test_a_problem_gives_the_same_alone_and_in_a_batch():
    residual, start = problem(3)
    found = bordered_least_squares(residual, start)
    torch.manual_seed(0)  # the same problems again
    again, _ = problem(3)

    def second(state):
        three = BorderedState(state.shared.expand(3, -1), state.own.expand(3, -1, -1))
        return again(three)[1]

    alone = bordered_least_squares(second, BorderedState(start.shared[1], start.own[1]))
    assert torch.allclose(alone.state.shared, found.state.shared[1], rtol=0, atol=1e-12)
    assert int(alone.iterations) == int(found.iterations[1])


def test_information_is_what_the_data_add_to_the_prior():
    residual, start = problem()
    found = bordered_least_squares(residual, start, tolerance=1e-8)
    information = shared_information(residual, found.state).sum(-3)
    precision = torch.linalg.inv(found.factor @ found.factor.mT)
    assert torch.allclose(information + torch.eye(SHARED).double(), precision, rtol=1e-6, atol=1e-9)


def test_steps_that_overshoot_are_halved():
    """arctan: plain Gauss-Newton steps diverge from a far start."""

    def residual(state):
        value = torch.atan(state.own[..., 0] - 1.0) * 10
        return torch.stack([value, 0.0 * value + state.shared], dim=-1)

    start = BorderedState(torch.zeros(1).double(), torch.full((1, 1), 4.0).double())
    found = bordered_least_squares(residual, start, tolerance=1e-9)
    assert bool(found.converged)
    assert float(found.state.own) == pytest.approx(1.0, abs=1e-8)


def test_a_problem_that_cannot_settle_says_so():
    residual, start = problem()
    assert not bool(bordered_least_squares(residual, start, max_iterations=1, tolerance=1e-12).converged)
