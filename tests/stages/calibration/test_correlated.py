"""Errors along the scan: their evidence, the noise that they make, and an n that is as far off as it says."""

import dataclasses
import math

import pytest
import torch

from lsvision.estimation import mean_chi_square_band, nees, upper_root
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan import SUSPICION, Linearised, by_chance, with_processes
from lsvision.stages.calibration.along_scan.evidence import NormalEquations
from lsvision.stages.calibration.along_scan.kernels import INTERVALS, KNOTS, SEARCHED, kernel_family, wave_length
from lsvision.stages.calibration.along_scan.lines import Travel, directions
from lsvision.stages.calibration.calibrate import calibrate, calibrate_batch
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import linearise, point_factor
from lsvision.stages.calibration.methods import joint
from lsvision.stages.calibration.model import residuals_in_sigmas, whitened_residuals
from lsvision.stages.calibration.verdict import UNLIKE
from tests.stages.calibration.boards import RIG, Corners, simulate

ROUGH, SMOOTH, WAVE = 1, 4, 13  # of the kernel family
SIDEWAYS, TRAVEL, DEPTH, ROLL = range(4)


def shaken(corners: Corners, rms_mm: float, wavelength_mm: float, components=(SIDEWAYS, DEPTH)) -> Corners:
    """The same corners, all of one line displaced together: a wave along the travel, of another phase in every scan."""
    points = corners.points.clone()
    travel = corners.points[..., 1]
    for component in components:
        phase = 2 * math.pi * torch.rand(*travel.shape[:-1], 1, dtype=torch.float64)
        points[..., component] += rms_mm * math.sqrt(2) * torch.sin(2 * math.pi * travel / wavelength_mm + phase)
    return dataclasses.replace(corners, points=points)


def solved(corners: Corners, method="joint", **options):
    parts = (corners.points, corners.covariance, corners.board_points, corners.valid)
    return calibrate_batch(*parts, CalibrationConfig(method=method, **options))


def errors(corners: Corners, found) -> torch.Tensor:
    """Normalised squared errors of n."""
    return nees(found.n - corners.n, torch.linalg.cholesky(found.covariance))


def dense_covariance(problem, roots: torch.Tensor) -> torch.Tensor:
    """Covariance of all points of each board, its white noise and the processes together."""
    weights, moved = Travel.of(problem).weights(problem), directions(problem)
    boards, corners = problem.valid.shape
    whole = torch.zeros(boards, corners, 3, corners, 3, dtype=torch.float64)
    for board in range(boards):
        for corner in range(corners):
            chol = problem.noise_chol[board, corner]
            whole[board, corner, :, corner, :] += chol @ chol.mT
        for component in range(4):
            part = (moved[board, :, component, :, None] * (weights[board] @ roots[component])[:, None]).flatten(0, 1)
            whole[board] += (part @ part.mT).reshape(corners, 3, corners, 3)
    return whole.reshape(boards, 3 * corners, 3 * corners)


def small_problem():
    """Ten corners of two boards, their noise correlated in itself, one not seen."""
    torch.manual_seed(3)
    corners = simulate(tilts=((10.0, 0.0, 20.0), (-5.0, 5.0, 1.0)))
    turned = torch.tensor([[1.0, 0.3, 0.2], [0.0, 1.0, -0.4], [0.0, 0.0, 1.0]], dtype=torch.float64)
    keep = slice(None, None, 9)
    valid = corners.valid[:, keep].clone()
    valid[1, 4] = False
    corners = dataclasses.replace(
        corners,
        points=corners.points[:, keep],
        covariance=turned @ corners.covariance[:, keep] @ turned.mT,
        board_points=corners.board_points[:, keep],
        valid=valid,
    )
    return corners.problem()


def some_roots() -> torch.Tensor:
    family = kernel_family()
    kernels = torch.stack([family.covariance[k] for k in (ROUGH, SMOOTH, WAVE, SMOOTH)])
    return covariance_root(kernels * torch.tensor([0.05, 0.1, 0.03, 0.04]).double().square()[:, None, None])


def test_reduced_rows_are_those_of_the_dense_covariance():
    problem, start = small_problem()
    roots = some_roots()
    noise = with_processes(problem, roots[None], SEARCHED)
    correlated = dataclasses.replace(problem, correlated=noise)
    covariance = dense_covariance(problem, roots)
    rows, log_det = torch.zeros(()).double(), torch.zeros(()).double()
    exact = residuals_in_sigmas(
        dataclasses.replace(problem, noise_chol=torch.eye(3).double().expand_as(problem.noise_chol)), start
    )
    exact = exact.reshape(2, -1)
    for board in range(2):
        seen = problem.valid[board].repeat_interleave(3)
        part = covariance[board][seen][:, seen]
        rows = rows + exact[board][seen] @ torch.linalg.solve(part, exact[board][seen])
        log_det = log_det + torch.logdet(part)
    torch.testing.assert_close(noise.log_det, log_det)
    torch.testing.assert_close(whitened_residuals(correlated, start).square().sum(), rows)
    linearised = linearise(correlated, start, point_factor(start))
    torch.testing.assert_close(linearised.matrix[..., -1].square().sum(), rows)
    doubled = correlated.scaled(torch.tensor(4.0).double())
    torch.testing.assert_close(whitened_residuals(doubled, start).square().sum(), rows / 4)
    torch.testing.assert_close(doubled.noise_log_det, log_det + 3 * 19 * math.log(4.0))


def test_evidence_is_the_restricted_likelihood_of_dense_covariances():
    problem, start = small_problem()
    posterior = joint(problem, start, CalibrationConfig())
    equations = NormalEquations.of(problem, Linearised.of(problem, posterior.mean, prior_sigma=0.05))
    standing = some_roots()
    family = kernel_family()
    variance = torch.tensor([1e-4, 2e-3], dtype=torch.float64)
    others = [SIDEWAYS, DEPTH, ROLL]
    given = equations.given(TRAVEL, torch.tensor(others), standing[others][None])
    ratios = equations.log_ratios(given, family, variance)

    def naive(root: torch.Tensor) -> torch.Tensor:
        """-2 log likelihood, the poses and n marginalised, by the whitened rows of the whole state."""
        roots = torch.stack([standing[SIDEWAYS], root, *standing[[DEPTH, ROLL]]])
        noise = with_processes(problem, roots[None], SEARCHED)
        correlated = dataclasses.replace(problem, correlated=noise)
        rows = linearise(correlated, posterior.mean, point_factor(posterior.mean)).matrix
        n = posterior.mean[-3:]
        prior = torch.zeros(3, rows.shape[-1]).double()
        prior[:, -4:-1], prior[:, -1] = torch.eye(3), torch.tensor([0.0, 1.0, 0.0]).double() - n
        triangle = upper_root(torch.cat([rows, prior / 0.05]))
        pivots = triangle.diagonal().abs().log()
        return noise.log_det + 2 * pivots[:-1].sum() + triangle[-1, -1].square()

    none = naive(torch.zeros(KNOTS, KNOTS).double())
    for kernel in (ROUGH, SMOOTH, WAVE):
        for i, value in enumerate(variance):
            expected = (none - naive(covariance_root(family.covariance[kernel] * value))) / 2
            torch.testing.assert_close(ratios[kernel, i], expected, rtol=0, atol=1e-3)


def test_length_of_a_wave_is_its_wavelength():
    place = torch.arange(KNOTS, dtype=torch.float64) / INTERVALS
    wave = torch.cos(2 * math.pi / 0.8 * (place[:, None] - place))
    assert wave_length(2.5 * wave).item() == pytest.approx(0.8, rel=0.02)


def test_sound_corners_are_left_to_the_bit():
    torch.manual_seed(0)
    corners = simulate(batch=(300,))
    found, without = solved(corners), solved(corners, correlated_odds=math.inf)
    opened = (found.along_scan_rms_mm > 0).any(-1)
    assert opened.sum() <= 6  # 2 %
    assert torch.equal(found.n[~opened], without.n[~opened])
    assert torch.equal(found.covariance[~opened], without.covariance[~opened])
    low, high = mean_chi_square_band(3, 300)
    assert low < errors(corners, found).mean() < high


def test_noise_that_is_larger_than_stated_is_not_taken_for_an_error_along_the_scan():
    torch.manual_seed(1)
    corners = simulate(batch=(100,))
    larger = dataclasses.replace(corners, covariance=corners.covariance / 4)
    found = solved(larger)
    assert (found.along_scan_rms_mm > 0).any(-1).sum() <= 2
    assert found.noise_scale.median().item() == pytest.approx(4.0, rel=0.1)


def test_a_suspicion_falls_on_few_sound_sets_and_on_all_shaken_ones():
    torch.manual_seed(2)
    corners = simulate(batch=(300,))
    for measured, share in ((corners, (0.0, 0.03)), (shaken(corners, 0.03, 233.0), (0.99, 1.0))):
        problem, start = measured.problem()
        posterior = joint(problem, start, CalibrationConfig())
        suspected = (by_chance(problem, residuals_in_sigmas(problem, posterior.mean)) < SUSPICION).double().mean()
        assert share[0] <= suspected <= share[1]


@pytest.mark.parametrize(
    ("rms_mm", "wavelength_mm", "components"),
    [(0.03, 97.0, (SIDEWAYS, DEPTH)), (0.03, 480.0, (SIDEWAYS, DEPTH)), (0.1 / math.sqrt(2), 400.0, (TRAVEL,))],
)
def test_sigma_covers_what_errors_along_the_scan_do_to_n(rms_mm, wavelength_mm, components):
    torch.manual_seed(4)
    corners = shaken(simulate(batch=(4,)), rms_mm, wavelength_mm, components)
    found = solved(corners)
    assert errors(corners, found).max() < 16.3  # one in a thousand is larger
    shown = list(components)
    assert (found.along_scan_rms_mm[:, shown].median(0).values / rms_mm - 1).abs().max() < 1.5
    blind = solved(corners, correlated_odds=math.inf)
    assert (found.n - corners.n).square().mean() < (blind.n - corners.n).square().mean() * 1.3


def test_a_batch_gives_the_bits_of_its_problems_alone():
    torch.manual_seed(5)
    corners = simulate(batch=(3,))
    points = torch.stack([corners.points[0], shaken(corners, 0.1, 150.0).points[1], corners.points[2]])
    together = solved(dataclasses.replace(corners, points=points))
    assert (together.along_scan_rms_mm > 0).any(-1).tolist() == [False, True, False]
    alone = solved(dataclasses.replace(corners, points=points[1:2], covariance=corners.covariance[1:2],
                                       board_points=corners.board_points[1:2], valid=corners.valid[1:2]))  # fmt: skip
    assert torch.equal(together.n[1], alone.n[0])
    assert torch.equal(together.covariance[1], alone.covariance[0])


@pytest.mark.slow
def test_all_methods_allow_for_the_same_errors():
    torch.manual_seed(6)
    corners = shaken(simulate(), 0.05, 300.0)
    reference = solved(corners)
    for method in ("least_squares", "sequential"):
        found = solved(corners, method=method)
        sigma = reference.covariance.diagonal().sqrt()
        assert ((found.n - reference.n).abs() < 0.1 * sigma).all()
        torch.testing.assert_close(found.covariance.diagonal().sqrt(), sigma, rtol=0.02, atol=0)


def test_a_shaken_board_that_moves_as_nominal_is_no_contradiction():
    torch.manual_seed(8)
    nominal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    corners = shaken(simulate(n=nominal), 0.3, 480.0)
    result = calibrate(corners.boards(), RIG, CalibrationConfig())
    assert result.verdict == "determined"
    assert result.rmse_after_mm < 1.1 * result.rmse_before_mm


def test_what_was_allowed_for_is_said():
    torch.manual_seed(7)
    corners = shaken(simulate(), 0.05, 150.0, components=(SIDEWAYS,))
    result = calibrate(corners.boards(), RIG, CalibrationConfig())
    (error,) = result.errors_along_scan
    assert error.component == "x"
    assert error.rms_mm == pytest.approx(0.05, rel=0.5)
    assert error.length_mm == pytest.approx(150.0, rel=0.2)
    assert error.in_words.startswith("errors along the scan: 0.0")
    assert " mm rms sideways, about 1" in error.in_words
    assert calibrate(simulate().boards(), RIG, CalibrationConfig()).errors_along_scan == ()


def rolled(corners: Corners, rms_mm: float, wavelength_mm: float) -> Corners:
    """The same corners, all of one line turned together about the travel, by an axis half a metre below the board."""
    points, travel = corners.points.clone(), corners.points[..., 1]
    lever = corners.points[..., 0] - corners.points[..., 0].mean()
    phase = 2 * math.pi * torch.rand(*travel.shape[:-1], 1, dtype=torch.float64)
    angle = (
        math.sqrt(2) * torch.sin(2 * math.pi * travel / wavelength_mm + phase) * rms_mm / lever.square().mean().sqrt()
    )
    points[..., 0] -= angle * (corners.points[..., 2].mean() + 500.0 - corners.points[..., 2])
    points[..., 2] -= angle * lever
    return dataclasses.replace(corners, points=points)


def turned_about_the_view(corners: Corners, rms_rad: float, wavelength_mm: float) -> Corners:
    """The same corners, each line's travel wrong in proportion to the place across it, which no component describes."""
    points, travel = corners.points.clone(), corners.points[..., 1]
    phase = 2 * math.pi * torch.rand(*travel.shape[:-1], 1, dtype=torch.float64)
    angle = rms_rad * math.sqrt(2) * torch.sin(2 * math.pi * travel / wavelength_mm + phase)
    points[..., 1] += angle * (points[..., 0] - points[..., 0].mean(-1, keepdim=True))
    return dataclasses.replace(corners, points=points)


def rough(corners: Corners, rms_mm: float, length_mm: float, components=(SIDEWAYS, DEPTH)) -> Corners:
    """The same corners, all of one line displaced together: by a process whose correlation falls exponentially."""
    points, travel = corners.points.clone(), corners.points[..., 1]
    distance = (travel[..., :, None] - travel[..., None, :]).abs()
    root = torch.linalg.cholesky(torch.exp(-distance / length_mm) + 1e-9 * torch.eye(travel.shape[-1]).double())
    for component in components:
        points[..., component] += rms_mm * (root @ torch.randn(*travel.shape, 1, dtype=torch.float64))[..., 0]
    return dataclasses.replace(corners, points=points)


def test_a_turn_about_the_travel_is_found_as_one():
    torch.manual_seed(10)
    corners = rolled(simulate(), 0.05, 150.0)
    result = calibrate(corners.boards(), RIG, CalibrationConfig())
    assert result.verdict == "determined"
    (roll,) = (error for error in result.errors_along_scan if error.component == "roll")
    assert roll.rms_mm == pytest.approx(0.05, rel=0.5)
    assert "by a turn about the travel" in roll.in_words
    assert nees(result.motion.n - corners.n, torch.linalg.cholesky(result.motion.covariance)) < 16.3


def test_errors_that_no_component_describes_are_a_contradiction():
    torch.manual_seed(11)
    result = calibrate(turned_about_the_view(simulate(), 3e-4, 150.0).boards(), RIG, CalibrationConfig())
    assert result.verdict == "inconsistent"
    assert UNLIKE in result.reasons


@pytest.mark.slow
def test_errors_that_are_modelled_are_rarely_said_to_be_unlike_any():
    torch.manual_seed(12)
    sets = simulate(batch=(20,))
    for corners in (shaken(sets, 0.03, 150.0), rough(sets, 0.05, 60.0)):
        assert solved(corners).along_scan_unlike.sum() <= 1
    assert solved(turned_about_the_view(sets, 3e-4, 150.0)).along_scan_unlike.double().mean() > 0.9


@pytest.mark.slow
def test_normalised_errors_under_a_correlation_of_60_mm_keep_their_band():
    torch.manual_seed(13)
    corners = rough(simulate(batch=(200,)), 0.03, 60.0)
    assert 2.5 < errors(corners, solved(corners)).mean() < 3.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rms_mm", "wavelength_mm", "components"),
    [
        (0.03, 61.0, (SIDEWAYS, DEPTH)),
        (0.03, 233.0, (SIDEWAYS, DEPTH)),
        (0.03, 480.0, (SIDEWAYS, DEPTH)),
        (0.1 / math.sqrt(2), 400.0, (TRAVEL,)),
    ],
)
def test_normalised_errors_of_many_shaken_sets_keep_near_their_band(rms_mm, wavelength_mm, components):
    """Nor far below it: that would be sigmas much wider than need be."""
    torch.manual_seed(9)
    corners = shaken(simulate(batch=(40,)), rms_mm, wavelength_mm, components)
    assert 1.2 < errors(corners, solved(corners)).mean() < 3.6
