"""The posterior over the turn of n that boards hardly show, and the mode that it is taken about."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lsvision.estimation import Prior
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.mode import find_mode, rows_of, step_from
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.turn import is_curved, spread_along_turn, turn, turn_gradient
from tests.stages.calibration.boards import RIG, drawn, simulate, thinned

METHODS = ("joint", "two_step", "sequential", "least_squares")
angles = st.floats(-12.0, 12.0)
tilts = st.lists(st.tuples(angles, angles, st.floats(-30.0, 30.0)), min_size=1, max_size=3)


def mode_and_rows(corners, prior_sigma):
    problem, start = corners.problem()
    further = rows_of(prior_about(start, CalibrationConfig(prior_sigma=prior_sigma)))
    return problem, further, find_mode(problem, further, start, 20, 1e-3)


def test_the_mode_is_found_from_far_away():
    """Half and one and a half times the nominal motion, and 30 degrees off it."""
    for n in ([0.0, 0.5, 0.0], [0.0, 1.5, 0.0], [0.5, 0.9, 0.0], [0.0, 0.9, 0.3]):
        corners = simulate(n=torch.tensor(n, dtype=torch.float64))
        _, _, mode = mode_and_rows(corners, 0.3)
        assert mode.converged
        assert mode.iterations <= 8
        assert (mode.state[-3:] - corners.n).abs().max() < 2e-3


def test_a_step_is_one_of_the_state_to_first_order():
    state = torch.tensor([0.1, -0.2, 0.0, 1.0, 2.0, 3.0, 0.03, 1.02, -0.01], dtype=torch.float64)
    step = 1e-6 * torch.randn(9, dtype=torch.float64)
    torch.testing.assert_close(step_from(state, step), state + step, rtol=0, atol=1e-11)


def test_the_gradient_of_the_turn_is_its_derivative():
    state = torch.randn(15, dtype=torch.float64)
    torch.testing.assert_close(turn_gradient(state), torch.func.jacrev(turn)(state))


def test_spread_of_a_flat_board_is_that_of_the_prior_on_its_circle():
    """n = s (cos ψ, sin ψ) and a prior of n about (1, 0) give ψ the density exp(s cos ψ / σ²): von Mises."""
    sigma = 0.3
    corners = simulate([(0.0, 0.0, 0.0)], sigma=(1e-3, 1e-3, 1e-3), n=torch.tensor([0.0, 1.0, 0.0]).double())
    problem, further, mode = mode_and_rows(corners, sigma)
    factor = spread_along_turn(problem, further, mode, sigma).factor[-3:]
    moments = (factor @ factor.mT).diagonal()[1:]  # of n2 and n3 about the mode
    phi = torch.linspace(-math.pi, math.pi, 100_001, dtype=torch.float64)
    weight = torch.exp((torch.cos(phi) - 1) / sigma**2)
    weight = weight / weight.sum()
    s, middle = mode.state[-3:].norm(), torch.atan2(mode.state[-1], mode.state[-2])
    n2, n3 = s * torch.cos(middle + phi), s * torch.sin(middle + phi)
    expected = [(weight * (n - at).square()).sum() for n, at in ((n2, mode.state[-2]), (n3, mode.state[-1]))]
    assert moments.tolist() == pytest.approx([float(value) for value in expected], rel=0.03)


def test_several_tilts_are_straight_and_one_is_not():
    for boards, curved in (([(0.0, 0.0, 0.0)], True), ([(8.0, 0.0, 0.0), (-8.0, 0.0, 0.0)], False)):
        problem, _, mode = mode_and_rows(simulate(boards), 0.05)
        assert bool(is_curved(problem, mode.here.factor)) == curved


def test_a_batch_is_a_loop():
    corners = drawn([(0.0, 0.0, 0.0)], 0.05, runs=3)
    problem, start = corners.problem()
    prior = prior_about(start, CalibrationConfig())
    mode = find_mode(problem, rows_of(prior), start, 20, 1e-3)
    together = spread_along_turn(problem, rows_of(prior), mode, 0.05)
    for index in range(3):
        mask = torch.arange(3) == index
        one = rows_of(Prior(prior.mean[mask], prior.root[mask]))
        alone = find_mode(problem.at(mask), one, start[mask], 20, 1e-3)
        assert torch.equal(alone.state[0], mode.state[index])
        assert torch.equal(spread_along_turn(problem.at(mask), one, alone, 0.05).factor[0], together.factor[index])


@settings(max_examples=8, deadline=None, derandomize=True)
@given(tilts, st.sampled_from([0.01, 0.05, 0.3]), st.sampled_from(METHODS), st.integers(0, 2**16))
def test_no_verdict_contradicts_its_sigmas(boards, prior_sigma, method, seed):
    """Determined: every direction of the stated covariance is at most half as wide as the prior, and else it is not."""
    torch.manual_seed(seed)
    corners = thinned(simulate(boards))
    result = calibrate(corners.boards(), RIG, CalibrationConfig(method=method, prior_sigma=prior_sigma))
    covariance = result.motion.covariance
    widest = float(torch.linalg.eigvalsh(covariance)[-1].sqrt())
    if result.verdict == "determined":
        assert widest < 0.5 * prior_sigma
        assert (result.motion.sigma < 0.5 * prior_sigma).all()
    if result.verdict == "prior-dominated":
        assert widest >= 0.5 * prior_sigma
    for direction in result.observability.directions:
        vector = torch.tensor(direction.vector, dtype=torch.float64)
        assert direction.posterior_sigma == pytest.approx(
            float((vector @ covariance @ vector).clamp(min=0).sqrt()), rel=1e-6, abs=1e-9
        )
        assert direction.observed == (direction.posterior_sigma < 0.5 * direction.prior_sigma)


def test_two_boards_almost_of_one_tilt_are_not_called_determined():
    result = calibrate(simulate([(5.0, 0.0, 0.0), (5.2, 0.0, 0.0)]).boards(), RIG, CalibrationConfig(prior_sigma=0.01))
    assert result.motion.sigma[2] > 0.005
    assert result.verdict == "prior-dominated"


@pytest.mark.parametrize("method", METHODS)
def test_what_cannot_converge_says_so_and_is_finite(method):
    """An object that hardly moves along the scan, under a prior that allows it."""
    corners = simulate([(2.0, 1.5, 0.0)], n=torch.tensor([0.4, 0.09, -0.2]).double())
    result = calibrate(thinned(corners).boards(), RIG, CalibrationConfig(method=method, prior_sigma=0.3))
    assert result.verdict == "not converged"
    assert result.motion.n.isfinite().all()
    assert result.motion.covariance.isfinite().all()
