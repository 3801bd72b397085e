"""Directions that boards cannot show are named, and the tilt proposed is the one that helps most."""

from dataclasses import replace

import pytest
import torch

from lsvision.estimation import weighed_directions
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.methods import joint
from lsvision.stages.calibration.observability import TILT_GRID_DEG, next_tilt, simulated_information
from lsvision.stages.calibration.problem import BoardState
from tests.stages.calibration.boards import RIG, simulate, true_motion

LEVEL = true_motion(pitch_deg=0.0)  # the prior's mean is the truth along the direction that one tilt cannot show


def report(tilts):
    return calibrate(simulate(tilts).boards(), RIG, CalibrationConfig()).observability


@pytest.mark.parametrize(
    "tilts",
    [
        [(0.0, 0.0, 0.0)],
        [(12.0, 0.0, 5.0)],
        [(0.0, 0.0, 0.0), (0.0, 0.0, 30.0), (0.0, 0.0, -20.0)],
        [(8.0, 0.0, 0.0)] * 3,
    ],
    ids=["one flat board", "one tilted board", "flat boards turned in plane", "repeats of a tilt"],
)
def test_a_single_tilt_does_not_show_n3(tilts):
    found = report(tilts)
    assert not found.determined
    assert [direction.observed for direction in found.directions] == [False, True, True]
    weakest = found.directions[0]
    assert abs(weakest.vector[2]) > 0.95
    assert weakest.posterior_sigma == pytest.approx(0.05, rel=0.05)
    assert "n3 (in depth)" in found.advice
    assert "15 deg about the sensor axis" in found.advice


@pytest.mark.parametrize("second", [(10.0, 0.0, 0.0), (0.0, 10.0, 0.0)], ids=["about X", "about Y"])
def test_two_boards_ten_degrees_apart_determine_n(second):
    found = report([(0.0, 0.0, 0.0), second])
    assert found.determined
    assert all(direction.observed and direction.posterior_sigma < 5e-4 for direction in found.directions)


def test_directions_are_orthogonal_and_their_sigmas_the_posteriors():
    result = calibrate(simulate().boards(), RIG, CalibrationConfig())
    vectors = torch.tensor([direction.vector for direction in result.observability.directions], dtype=torch.float64)
    torch.testing.assert_close(vectors @ vectors.mT, torch.eye(3).double(), rtol=0, atol=1e-12)
    along = (vectors @ result.motion.covariance @ vectors.mT).diagonal().sqrt()
    assert [d.posterior_sigma for d in result.observability.directions] == pytest.approx(along.tolist(), rel=1e-3)


def posterior_sigma(tilts, direction):
    """Posterior sigma of n along a direction after calibrating on simulated scans of these tilts, batch at once."""
    problem, start = simulate(tilts, n=LEVEL).problem()
    factor = joint(problem, start, CalibrationConfig()).factor[-3:]
    return torch.linalg.vector_norm(direction @ factor).item()


@pytest.mark.parametrize("first", [(0.0, 0.0, 0.0), (6.0, 0.0, 0.0), (0.0, 8.0, 0.0)])
def test_the_proposed_tilt_lowers_the_sigma_most_when_it_is_scanned(first):
    problem, start = simulate([first], n=LEVEL).problem()
    state = joint(problem, start, CalibrationConfig()).mean
    proposal = next_tilt(problem, state, 0.05)
    weakest = weighed_directions(motion_information(problem, state), 0.05).weakest
    sigma = {(x, y): posterior_sigma([first, (x, y, 0.0)], weakest) for x in TILT_GRID_DEG for y in TILT_GRID_DEG}
    assert sigma[proposal] <= 1.002 * min(sigma.values())
    assert sigma[proposal] < 0.01 * 0.05


def test_simulated_information_is_that_of_a_scan_at_that_tilt():
    problem, start = simulate([(0.0, 0.0, 0.0)]).problem()
    now = BoardState.split(start)
    found = simulated_information(problem, start, torch.tensor([[10.0, -5.0], [0.0, 0.0]]).double())
    exact = simulate([(10.0, -5.0, 0.0)], sigma=(0.0, 0.0, 0.0), n=now.n, origin=(20.0, 60.0, 800.0))
    scanned, _ = exact.problem()
    at = BoardState(torch.zeros(1, 3).double(), now.position, now.n).join()
    scanned = replace(scanned, noise_chol=problem.noise_chol, rotation=exact.rotation)
    expected = motion_information(scanned, at)
    assert (found[0] - expected).norm() / expected.norm() < 0.1
    assert weighed_directions(found[1], 0.05).share[0] == pytest.approx(1.0, abs=1e-6)
