"""The spectrum of errors along the scan: its likelihood, how well it is known, and which kind of it is found."""

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import pad

from lsvision.estimation.gaussian_process import covariance_root, matern32
from lsvision.geometry import shaken
from lsvision.simulation import BoardPose
from lsvision.stages.calibration.along_scan import Linearised, Spectrum, edge_rows, search_with_edges
from lsvision.stages.calibration.along_scan.evidence import NormalEquations
from lsvision.stages.calibration.along_scan.kernels import FINE, KNOTS, SEARCHED, covariance_of, kernel_family
from lsvision.stages.calibration.along_scan.lines import Travel
from lsvision.stages.calibration.along_scan.parameters import Scores, climbed, log_posterior, moved
from lsvision.stages.calibration.along_scan.projected import Projected
from lsvision.stages.calibration.along_scan.search import evidence_by_component
from lsvision.stages.calibration.along_scan.variances import as_large_as_probable, stepped
from lsvision.stages.calibration.along_scan.waves import with_waves
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.study.points import Conditions, exact_corners
from lsvision.study.shaken import ScanNoise, Vibration, shaken_scans
from lsvision.types import Board
from tests.stages.calibration.boards import FOUR_TILTS, RIG, simulate
from tests.stages.calibration.edges import Motion, edges_of, with_lines
from tests.stages.calibration.test_edges import PIVOT, SIZES, TWO_TILTS, at_truth, shaken_boards

SHARP = (0.005, 0.005, 0.005)
COUNT = len(kernel_family(FINE).log_prior)


def setting(seed: int) -> tuple[BoardProblem, Linearised, NormalEquations]:
    """Two boards under waves of 61, 97 and 233 mm, with edges, about the truth."""
    corners, motion = shaken_boards(seed, TWO_TILTS)
    problem, state = at_truth(corners)
    linearised = Linearised.of(problem, state, prior_sigma=0.05)
    rows = edge_rows(problem, state, edges_of(corners, motion))
    return problem, linearised, NormalEquations.of(problem, linearised, FINE, rows)


def some_spectrum(problem: BoardProblem) -> Spectrum:
    """Two kernels, and the waves of the vibration in three components, one of them a little off."""
    variances = torch.zeros(4, COUNT, dtype=torch.float64)
    variances[0, 3], variances[2, 4], variances[3, 20] = 1e-4, 2e-4, 1e-4
    of_waves = torch.tensor([[0.03, 0.02, 0.03], [0.0, 0.0, 0.0], [0.02, 0.04, 0.03], [2e-4, 3e-4, 2e-4]]).double()
    lengths = torch.tensor([61.0, 97.0, 234.0], dtype=torch.float64)
    return Spectrum(variances, Travel.of(problem).extent_mm / lengths, of_waves)


def n_of(equations: NormalEquations, spectrum: Spectrum) -> torch.Tensor:
    """n by the normal equations of everything, dense: how far it is from where they are linearised."""
    roots = covariance_root(spectrum.covariance(FINE))
    root = torch.block_diag(*roots)
    gram = root.mT @ equations.gram.transpose(2, 3).flatten(3, 4).flatten(1, 2) @ root
    cross = root.mT @ equations.cross.flatten(1, 2)
    inner = gram + torch.eye(gram.shape[-1], dtype=gram.dtype)
    state = equations.state - cross.mT @ torch.linalg.solve(inner, cross)
    boards = len(state)
    information = torch.zeros(6 * boards + 3, 6 * boards + 4, dtype=gram.dtype)
    for board in range(boards):
        own = [*range(6 * board, 6 * board + 6), -4, -3, -2]
        place = [*range(6 * board, 6 * board + 6), *range(6 * boards, 6 * boards + 3)]
        for row in range(9):
            for column, index in enumerate([*own, -1]):
                information[place[row], index] += state[board, row, column]
    prior = equations.prior.mT @ equations.prior
    information[-3:, -4:] += prior[:3]
    return torch.linalg.solve(information[:, :-1], information[:, -1])[-3:]


def test_covariance_is_that_of_kernels_and_waves():
    spectrum = some_spectrum(setting(1)[0])
    place = FINE.place(spectrum.frequency)
    distance = place[:, None] - place
    waves = sum(
        spectrum.of_waves[:, i, None, None] * torch.cos(2 * math.pi * spectrum.frequency[i] * distance)
        for i in range(3)
    )
    torch.testing.assert_close(spectrum.covariance(FINE), covariance_of(spectrum.variances, FINE) + waves)
    batch = Spectrum.of_kernels(torch.zeros(2, 4, COUNT, dtype=torch.float64)).padded()
    batch.set((1,), spectrum)
    torch.testing.assert_close(batch.at((1,)).covariance(SEARCHED), spectrum.covariance(SEARCHED))
    assert not batch.at((0,)).covariance(SEARCHED).any()
    assert SEARCHED.count == KNOTS


def test_gradient_and_response_of_n_are_those_of_small_steps():
    problem, _, equations = setting(2)
    spectrum = some_spectrum(problem)
    scores = Scores.of(equations, spectrum)
    size = 1e-4
    for index in range(len(scores.gradient)):
        step = torch.zeros_like(scores.gradient)
        step[index] = size
        ahead, back = moved(spectrum, scores.active, step), moved(spectrum, scores.active, -step)
        slope = (log_posterior(equations, ahead) - log_posterior(equations, back)) / (2 * size)
        assert float(scores.gradient[index]) == pytest.approx(slope, rel=1e-3, abs=1e-3)
        response = (n_of(equations, ahead) - n_of(equations, back)) / (2 * size)
        torch.testing.assert_close(scores.of_shared[:, index], response, rtol=2e-3, atol=1e-9)
    torch.testing.assert_close(scores.information, scores.information.mT)
    assert float(torch.linalg.eigvalsh(scores.information).min()) > -1e-6


def test_information_is_that_of_the_restricted_likelihood():
    """tr(P K' P K') / 2, board by board, and the prior's."""
    problem, _, equations = setting(3)
    spectrum = some_spectrum(problem)
    data, scores = Projected.of(equations, spectrum.covariance(FINE)), Scores.of(equations, spectrum)
    wave = spectrum.of_waves[0, 0] * torch.cos(
        2 * math.pi * spectrum.frequency[0] * (FINE.place(data.weighed)[:, None] - FINE.place(data.weighed))
    )
    index = int(((scores.active[:, 0] == 0) & (scores.active[:, 1] == COUNT)).nonzero())
    prior = float(spectrum.of_waves[0, 0] / equations.rms_mm[0].square())
    expected = 0.5 * float(sum((board @ wave @ board @ wave).trace() for board in data.own[:, 0]))
    assert float(scores.information[index, index]) == pytest.approx(expected + prior, rel=1e-6)


def test_no_step_lowers_the_posterior():
    problem, _, equations = setting(4)
    usual = equations.rms_mm.square()[:, None]
    spectrum = Spectrum.of_kernels((usual / COUNT).expand(-1, COUNT))
    before = -math.inf
    for _ in range(4):
        spectrum = stepped(equations, spectrum, 3)
        assert log_posterior(equations, spectrum) > before
        before = log_posterior(equations, spectrum)
    one = torch.zeros(4, COUNT, dtype=torch.float64)
    one[0, 4] = one[2, 4] = one[3, 4] = 0.09  # a broad band instead
    found, _ = evidence_by_component(equations, spectrum.covariance(FINE)[None])
    other, _ = evidence_by_component(equations, covariance_of(one, FINE)[None])
    assert float(found) > float(other) + 100
    begun = some_spectrum(problem)
    assert log_posterior(equations, climbed(equations, begun, 3)) > log_posterior(equations, begun)
    probable = as_large_as_probable(equations, spectrum)
    assert bool((probable.variances >= spectrum.variances).all())


def test_waves_are_found_at_their_frequencies():
    problem, _, equations = setting(5)
    usual = equations.rms_mm.square()[:, None]
    kernels = stepped(equations, Spectrum.of_kernels((usual / COUNT).expand(-1, COUNT)), 30, 10)
    found = with_waves(equations, kernels)
    sigma = Scores.of(equations, found).frequency_sigma
    extent = float(Travel.of(problem).extent_mm)
    for length in (61.0, 97.0, 233.0):
        off = (found.frequency - extent / length).abs()
        nearest = int(off.argmin())
        assert float(sigma[nearest]) < 0.02
        assert float(off[nearest] / sigma[nearest]) < 4.0


def random_motion(boards: int, length_mm: float) -> Motion:
    """A smooth random motion of a correlation length: no waves."""
    knots = torch.arange(-20.0, 420.0, 2.0, dtype=torch.float64)
    root = covariance_root(matern32((knots[:, None] - knots) / length_mm))
    size = torch.tensor(SIZES, dtype=torch.float64)[:, None]
    drawn = size * (root @ torch.randn(boards, 3, len(knots), 1, dtype=torch.float64))[..., 0]

    def motion(travel: torch.Tensor) -> torch.Tensor:
        position = ((travel + 20.0) / 2.0).clamp(0.0, len(knots) - 1.001)
        first = position.long()
        share = (position - first)[:, None]
        index = first[:, None].expand(-1, 3, -1)
        values = drawn[: len(travel)]
        between = (1 - share) * values.gather(-1, index) + share * values.gather(-1, index + 1)
        return pad(between.mT, (0, 1))

    return motion


def normalised_error(seed: int, length_mm: float | None) -> float:
    """NEES of n of a simulated calibration with edges: of waves, or of a random motion of some length."""
    if length_mm is None:
        corners, motion = shaken_boards(seed)
    else:
        torch.manual_seed(seed)
        motion = random_motion(len(FOUR_TILTS), length_mm)
        corners = simulate(FOUR_TILTS, sigma=SHARP)
        points = corners.points.clone()
        points[..., ::2] = shaken(points[..., ::2], motion(points[..., 1]), PIVOT)
        corners = dataclasses.replace(corners, points=points)
    result = calibrate(with_lines(corners), RIG, CalibrationConfig(), edges_of(corners, motion))
    error = result.motion.n - corners.n
    return float(error @ torch.linalg.solve(result.motion.covariance, error))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2109, 2379, 2398])
def test_waves_are_found_one_by_one(seed):
    """Three waves that began as five, as kernels alone, or as two: n was 7.5, 13.6 and 5.4 sigmas off."""
    chance = torch.Generator().manual_seed(seed)
    poses = [BoardPose(*angles) for angles in ((2, 1.5, 0), (-5, 1, 6), (5, -2, -8), (-1, -3.5, 14))]
    exact = exact_corners(
        RIG, Board(12, 9, 30.0), {"four": poses}, Conditions("four", angle_x_deg=2.0, angle_z_deg=1.5, stretch=1.0246)
    )
    lengths = 60.0 * 5.0 ** torch.rand(3, generator=chance, dtype=torch.float64)
    motion = Vibration.drawn((0.3, 0.3, 3e-4), lengths.tolist(), len(poses), chance)
    scans = shaken_scans(RIG, Board(12, 9, 30.0), exact, motion, ScanNoise(), chance)
    found = calibrate(scans.corners, RIG, CalibrationConfig(), scans.edges)
    assert found.verdict == "determined"
    error = found.motion.n - exact.n
    assert float(error @ torch.linalg.solve(found.motion.covariance, error)) < 14.0  # 3 in a thousand are above


@pytest.mark.slow
def test_a_random_motion_is_no_sum_of_waves():
    torch.manual_seed(6)
    motion = random_motion(2, 40.0)
    corners = simulate(TWO_TILTS, sigma=SHARP)
    points = corners.points.clone()
    points[..., ::2] = shaken(points[..., ::2], motion(points[..., 1]), PIVOT)
    corners = dataclasses.replace(corners, points=points)
    problem, state = at_truth(corners)
    linearised = Linearised.of(problem, state, prior_sigma=0.05)
    rows = edge_rows(problem, state, edges_of(corners, motion))
    found = search_with_edges(problem, linearised, rows)
    assert found.spectrum.waves == 0
    assert not found.spectrum.variances[:, 6:].any()


@pytest.mark.slow
@pytest.mark.parametrize("length_mm", [None, 30.0])
def test_errors_of_n_are_as_large_as_stated(length_mm):
    """The mean of ten chi-square variables of three degrees of freedom is below 6 but for one in ten thousand.

    A random motion of 100 mm does not pass.
    """
    errors = torch.tensor([normalised_error(seed, length_mm) for seed in range(300, 310)])
    assert float(errors.mean()) < 6.0
    assert float(errors.max()) < 25.0
