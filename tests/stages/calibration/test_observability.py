"""Directions that boards cannot show are named, and the tilt proposed is the one that helps most."""

from dataclasses import replace

import pytest
import torch

from lsvision.estimation import principal_directions
from lsvision.geometry import transform
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.methods import joint
from lsvision.stages.calibration.observability import Known, next_tilt, possible_tilts, simulated_information
from lsvision.stages.calibration.problem import BoardState
from tests.stages.calibration.boards import RIG, simulate, tilt, true_motion

LEVEL = true_motion(
    yaw_deg=0.0, pitch_deg=0.0
)  # the prior's mean is the truth along the direction that one tilt cannot show


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
    assert "deg about the sensor axis" in found.advice


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
    assert [d.posterior_sigma for d in result.observability.directions] == pytest.approx(along.tolist(), rel=1e-9)


def covariance_of(posterior):
    """The covariance of n."""
    factor = posterior.factor[-3:]
    return factor @ factor.mT


def posterior_sigma(tilts, direction):
    """Posterior sigma of n along a direction after calibrating on simulated scans of these tilts, batch at once."""
    problem, start = simulate(tilts, n=LEVEL).problem()
    factor = joint(problem, start, CalibrationConfig()).factor[-3:]
    return torch.linalg.vector_norm(direction @ factor).item()


@pytest.mark.parametrize("first", [(0.0, 0.0, 0.0), (6.0, 0.0, 0.0), (0.0, 8.0, 0.0)])
def test_the_proposed_tilt_lowers_the_sigma_most_when_it_is_scanned(first):
    problem, start = simulate([first], n=LEVEL).problem()
    found = joint(problem, start, CalibrationConfig())
    known = Known(covariance_of(found), 0.05, depth_range_mm=52.0)
    proposal = next_tilt(problem, found.mean, known)
    weakest = principal_directions(known.covariance, 0.05).weakest
    tilts = [tuple(tilt) for tilt in possible_tilts(problem, found.mean, 52.0).tolist()]
    sigma = {(x, y): posterior_sigma([first, (x, y, 0.0)], weakest) for x, y in tilts}
    best = min(sigma.values())
    assert sigma[proposal.about_x, proposal.about_y] <= 1.002 * best
    assert best < 0.02 * 0.05


@pytest.mark.parametrize("depth_mm", [5.0, 20.0, 52.0, 500.0])
def test_proposals_keep_to_the_depth_of_the_camera(depth_mm):
    corners = simulate([(0.0, 0.0, 20.0)], n=LEVEL)
    problem, start = corners.problem()
    tilts = possible_tilts(problem, joint(problem, start, CalibrationConfig()).mean, depth_mm)
    assert [0.0, 0.0] in tilts.tolist()
    assert tilts.abs().max() <= 15.0
    for about_x, about_y in tilts.tolist():
        z = transform(tilt(about_x, about_y, 20.0), torch.zeros(3).double(), corners.board_points[0])[..., 2]
        assert z.max() - z.min() <= depth_mm + 0.02
    advice = calibrate(corners.boards(), RIG, CalibrationConfig(depth_range_mm=depth_mm)).observability.advice
    assert "tilt the board" in advice


@pytest.mark.parametrize("reverse", [False, True])
def test_the_edge_that_is_raised_is_the_one_that_the_sentence_names(reverse):
    """The proposed tilt is scanned: its raised edge, nearer to the cameras, is the one named."""
    origin = (20.0, -380.0, 800.0) if reverse else (20.0, 60.0, 800.0)
    corners = simulate([(0.0, 0.0, 0.0)], n=LEVEL, origin=origin)
    advice = calibrate(corners.boards(), RIG, CalibrationConfig()).observability.advice
    problem, start = corners.problem()
    found = joint(problem, start, CalibrationConfig())
    proposal = next_tilt(problem, found.mean, Known(covariance_of(found), 0.05, depth_range_mm=52.0))
    assert (proposal.about_x != 0, proposal.about_y != 0) == ("sensor axis" in advice, "travel axis" in advice)
    tilted = simulate([(proposal.about_x, proposal.about_y, 0.0)], n=LEVEL, origin=origin, sigma=(0.0, 0.0, 0.0))
    x, y, z = tilted.points[0].unbind(-1)
    assert proposal.about_x != 0
    first, last = z[y.abs().argmin()], z[y.abs().argmax()]
    if proposal.about_y == 0:
        assert f"the edge that is scanned {'first' if first < last else 'last'}" in advice
    else:
        assert ("larger" if z[x.argmax()] < z[x.argmin()] else "smaller") in advice


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
    precision = found[1] + torch.eye(3).double() / 0.05**2
    assert principal_directions(torch.linalg.inv(precision), 0.05).share[0] == pytest.approx(1.0, abs=1e-6)
