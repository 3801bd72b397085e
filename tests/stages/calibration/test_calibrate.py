"""Calibration from corners: all methods, the uncertainty they state, and bad data."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.errors import CalibrationError, ConfigError
from lsvision.estimation import Info, mean_chi_square_band, nees
from lsvision.geometry import displace, scan_position, transform
from lsvision.stages.calibration.calibrate import calibrate, calibrate_batch
from lsvision.stages.calibration.config import CalibrationConfig
from tests.stages.calibration.boards import (
    FOUR_TILTS,
    RIG,
    THREE_TILTS,
    drawn,
    simulate,
    thinned,
    true_motion,
    with_vibration,
)

METHODS = ("joint", "two_step", "sequential", "least_squares")
FIELDS = ("n", "covariance", "rotation", "translation_mm", "board_rmse_after_mm", "noise_scale", "converged", "info")


def batch_of(corners, config=None):
    config = config or CalibrationConfig()
    return calibrate_batch(corners.points, corners.covariance, corners.board_points, corners.valid, config)


@pytest.mark.parametrize("method", ["joint", "sequential", "least_squares"])
def test_three_tilts_find_the_motion_within_their_own_sigmas(method):
    corners = simulate()
    result = calibrate(corners.boards(), RIG, CalibrationConfig(method=method))
    error = (result.motion.n - corners.n).abs()
    assert (error < 3 * result.motion.sigma).all()
    assert (error < torch.tensor([1.5e-4, 5e-5, 5e-4])).all()
    assert result.converged
    assert result.noise_scale == 1.0
    assert result.verdict == "determined"
    floor = math.sqrt(sum(s * s for s in (0.020, 0.020, 0.014)))
    assert result.rmse_after_mm == pytest.approx(floor, rel=0.05)
    assert result.rmse_before_mm > 2.0
    assert (result.method, result.rig) == (method, RIG)
    for fit, rotation, translation in zip(result.boards, corners.rotation, corners.translation, strict=True):
        torch.testing.assert_close(fit.pose.rotation, rotation, rtol=0, atol=2e-3)
        torch.testing.assert_close(fit.pose.translation, translation, rtol=0, atol=0.1)
        assert fit.corners == 88


def test_joint_reaches_the_noise_floor_in_three_iterations():
    path = calibrate(simulate().boards(), RIG, CalibrationConfig()).iterations
    assert path[0].n == (0.0, 1.0, 0.0)
    assert path[0].stretch == 1.0
    assert path[3].rmse_mm == pytest.approx(path[-1].rmse_mm, rel=1e-6)
    assert path[2].rmse_mm < 0.04


def test_expected_sigmas_of_three_tilts():
    """The order of DESIGN's figures, which hold for tilts near these: (2.2e-5, 1.8e-5, 2.6e-4)."""
    tilts = [(5.0, 0.0, 0.0), (0.0, 5.0, 0.0), (-5.0, 0.0, 0.0)]
    sigma = calibrate(simulate(tilts).boards(), RIG, CalibrationConfig()).motion.sigma
    assert sigma.tolist() == pytest.approx([2.2e-5, 1.8e-5, 2.6e-4], rel=0.35)


def test_before_and_after_are_the_rmse_of_the_residuals():
    corners = simulate(THREE_TILTS[:2])
    result = calibrate(corners.boards(), RIG, CalibrationConfig())
    squares = []
    for points, body, fit in zip(corners.points, corners.board_points, result.boards, strict=True):
        moved = points * torch.tensor([1.0, 0.0, 1.0]) + points[:, 1:2] * result.motion.n
        error = moved - transform(fit.pose.rotation, fit.pose.translation, body)
        squares.append(error.square().sum(-1))
        assert fit.rmse_after_mm == pytest.approx(squares[-1].mean().sqrt().item())
    assert result.rmse_after_mm == pytest.approx(torch.cat(squares).mean().sqrt().item())
    assert result.improvement == pytest.approx(1 - result.rmse_after_mm / result.rmse_before_mm)


def test_filters_agree_with_least_squares_far_below_a_sigma():
    boards = simulate().boards()
    joint, sequential, reference = (
        calibrate(boards, RIG, CalibrationConfig(method=method, process_sigma=0.0))
        for method in ("joint", "sequential", "least_squares")
    )
    for found in (joint, sequential):
        assert ((found.motion.n - reference.motion.n).abs() < 1e-3 * reference.motion.sigma).all()
        torch.testing.assert_close(found.motion.covariance, reference.motion.covariance, rtol=1e-3, atol=1e-14)


def test_two_step_on_one_board_is_at_the_noise_in_five_iterations_and_says_what_it_cannot_know():
    """The paper's single board and its five iterations, of corners with the noise of a rendered scan."""
    corners = simulate([(2.0, 1.5, 0.0)], sigma=(0.005, 0.005, 0.0035))
    result = calibrate(corners.boards(), RIG, CalibrationConfig(method="two_step"))
    path = [iteration.rmse_mm for iteration in result.iterations]
    assert path[0] == pytest.approx(2.5, abs=0.02)
    assert path[:6] == pytest.approx([2.50, 1.13, 0.40, 0.143, 0.051, 0.020], rel=0.1)
    assert result.iterations[1].stretch == pytest.approx(1.0246, abs=2e-3)  # the stretch is right at once
    assert path[-1] == pytest.approx(0.0078, rel=0.1)
    assert result.converged
    assert len(path) <= 12
    assert result.verdict == "prior-dominated"
    assert ((result.motion.n - corners.n).abs() < 3 * result.motion.sigma).all()


def test_two_step_stops_at_its_threshold_and_knows_that_it_has_not_converged():
    corners = simulate([(0.0, 0.0, 0.0)])
    result = calibrate(corners.boards(), RIG, CalibrationConfig(method="two_step", two_step_threshold_mm=1.0))
    assert result.iterations[-1].rmse_mm <= 1.0 < result.iterations[-2].rmse_mm
    assert result.verdict == "not converged"
    assert ((result.motion.n - corners.n).abs() < 3 * result.motion.sigma).all()


@pytest.mark.parametrize(
    ("tilts", "settles"),
    [
        pytest.param([(2.0, 1.5, 0.0)], True, id="one"),
        pytest.param(FOUR_TILTS, False, marks=pytest.mark.slow, id="four"),
    ],
)
def test_two_step_covers_its_error_whether_it_settles_or_not(tilts, settles):
    """On four boards the RMSE stands still long before n3 does."""
    corners = drawn(tilts, prior_sigma=0.05, runs=200)
    found = batch_of(corners, CalibrationConfig(method="two_step"))
    z = (found.n - corners.n).abs() / found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert (z < 3).all(-1).double().mean() >= 0.95
    assert (found.converged.double().mean() > 0.95) == settles


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("prior_sigma", [0.05, pytest.param(0.3, marks=pytest.mark.slow)])
def test_errors_of_one_board_are_as_large_as_stated_over_all_that_the_prior_allows(method, prior_sigma):
    """The curve of n and poses that fit departs from its tangent by thousands of sigmas; a filter without drift."""
    corners = drawn([(2.0, 1.5, 0.0)], prior_sigma, runs=200)
    options = {"process_sigma": 0.0} if method == "sequential" else {}
    found = batch_of(corners, CalibrationConfig(method=method, prior_sigma=prior_sigma, **options))
    settled = found.converged
    assert settled.double().mean() > 0.85
    normalised = nees((found.n - corners.n)[settled], torch.linalg.cholesky(found.covariance[settled]))
    assert 2.5 < normalised.mean() < 3.6
    assert found.n.isfinite().all()


@pytest.mark.parametrize("method", ["joint", "two_step"])
def test_vibration_of_the_papers_floor_still_improves_as_the_paper_does(method):
    corners = with_vibration(simulate([(0.0, 0.0, 0.0)] if method == "two_step" else THREE_TILTS), 0.88)
    result = calibrate(corners.boards(), RIG, CalibrationConfig(method=method))
    assert result.improvement > 0.573
    assert result.noise_scale > 100


def test_larger_residuals_than_claimed_widen_the_sigmas_by_their_ratio():
    corners = simulate(THREE_TILTS[:2], batch=(60,), sigma=(0.1, 0.1, 0.07))
    claimed = replace(corners, covariance=corners.covariance / 25)
    honest, found = batch_of(corners), batch_of(claimed)
    assert found.noise_scale.median().item() == pytest.approx(25.0, rel=0.05)
    ratio = found.covariance.diagonal(dim1=-2, dim2=-1) / honest.covariance.diagonal(dim1=-2, dim2=-1)
    assert ratio.median().item() == pytest.approx(1.0, rel=0.05)
    assert (honest.noise_scale == 1).all()


def test_flat_board_keeps_the_prior_of_n3():
    """On the circle of the measured stretch s, n3 = s sin φ, the prior of n is exp(s cos φ / σ²): σ √s of n3."""
    result = calibrate(simulate([(0.0, 0.0, 0.0)]).boards(), RIG, CalibrationConfig())
    assert result.motion.sigma[2].item() == pytest.approx(0.05 * math.sqrt(1.0242), rel=1e-2)
    assert result.motion.sigma[0] < 1e-4
    assert result.noise_scale == 1.0


def test_noise_scale_of_a_filter_that_lets_n_drift_is_that_of_its_innovations():
    corners = thinned(simulate(THREE_TILTS[:2], batch=(60,), sigma=(0.1, 0.1, 0.07)))
    claimed = replace(corners, covariance=corners.covariance / 25)
    honest, found = (batch_of(item, CalibrationConfig(method="sequential")) for item in (corners, claimed))
    assert found.noise_scale.median().item() == pytest.approx(25.0, rel=0.05)
    ratio = found.covariance.diagonal(dim1=-2, dim2=-1) / honest.covariance.diagonal(dim1=-2, dim2=-1)
    assert ratio.median().item() == pytest.approx(1.0, rel=0.1)
    assert (honest.noise_scale == 1).double().mean() > 0.95


def test_least_squares_settles_on_every_sound_set():
    corners = thinned(simulate(batch=(300,)))
    assert batch_of(corners, CalibrationConfig(method="least_squares")).converged.all()


def test_known_mounting_pitch_replaces_the_second_tilt():
    corners = simulate([(4.0, 0.0, 0.0)])
    config = CalibrationConfig(mounting_pitch_deg=4.0, mounting_pitch_sigma_deg=0.05)
    result = calibrate(corners.boards(), RIG, config)
    assert result.verdict == "determined"
    assert result.motion.sigma[2].item() == pytest.approx(math.radians(0.05), rel=0.1)
    assert ((result.motion.n - corners.n).abs() < 3 * result.motion.sigma).all()
    reference = calibrate(corners.boards(), RIG, replace(config, method="least_squares"))
    assert ((result.motion.n - reference.motion.n).abs() < 0.01 * reference.motion.sigma).all()


def test_reversed_transport_keeps_n2_positive():
    """Later lines see smaller Y: the travel is negative, n is not."""
    corners = simulate(origin=(20.0, -380.0, 800.0))
    assert (corners.points[..., 1] < 0).all()
    result = calibrate(corners.boards(), RIG, CalibrationConfig())
    assert ((result.motion.n - corners.n).abs() < 3 * result.motion.sigma).all()
    assert result.rmse_after_mm < 0.035


def drifting(corners, process_sigma):
    """The same corners under an n that walks at random from line to line, and n at the end of the last scan."""
    order = corners.points[..., 1].mean(0).argsort(-1)
    y = corners.points[..., 1].mean(0).gather(-1, order)
    steps = torch.nn.functional.pad(y.diff(dim=-1), (1, 0)).sqrt() * process_sigma
    walk = (steps[..., None] * torch.randn(len(corners.points), *steps.shape, 3).double()).flatten(1, 2).cumsum(1)
    n = corners.n + walk.unflatten(1, steps.shape)
    at_corner = n.gather(2, order.argsort(-1)[None, ..., None].expand_as(n))
    return replace(corners, points=scan_position(displace(corners.points, corners.n), at_corner)), n[:, -1, -1]


def test_sequential_lets_n_drift_unless_the_options_say_otherwise():
    corners = simulate(THREE_TILTS[:2]).boards()
    drifting_sigma, own_sigma, fixed_sigma = (
        calibrate(corners, RIG, CalibrationConfig(method="sequential", process_sigma=value)).motion.sigma
        for value in (1e-6, None, 0.0)
    )
    assert torch.equal(own_sigma, drifting_sigma)
    assert (own_sigma > fixed_sigma).all()


@pytest.mark.slow
def test_sequential_knows_how_well_it_follows_an_n_that_drifts():
    corners, n_end = drifting(thinned(simulate(THREE_TILTS[:2], batch=(100,))), process_sigma=2e-5)
    followed = batch_of(corners, CalibrationConfig(method="sequential", process_sigma=2e-5))
    fixed = batch_of(corners, CalibrationConfig(method="sequential", process_sigma=0.0))
    low, high = mean_chi_square_band(3, 100)
    assert low < nees(followed.n - n_end, torch.linalg.cholesky(followed.covariance)).mean() < high
    assert nees(fixed.n - n_end, torch.linalg.cholesky(fixed.covariance)).mean() > 2 * high
    assert (followed.noise_scale == 1).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_bad_problem_changes_no_bit_of_the_others(method):
    corners = thinned(simulate(THREE_TILTS[:2], batch=(6,)))
    points, covariance = corners.points.clone(), corners.covariance.clone()
    points[1, 0, 5] = math.nan
    covariance[2, 1, 7] = 0.0
    covariance[4, 0, 0, 1, 1] = math.inf
    config = CalibrationConfig(method=method, max_iterations=6, two_step_max_iterations=3)
    found = batch_of(replace(corners, points=points, covariance=covariance), config)
    assert (found.info == Info.SINGULAR).tolist() == [False, True, True, False, True, False]
    assert found.n[[1, 2, 4]].isnan().all()
    for i in (0, 3, 5):
        alone = batch_of(
            replace(
                corners,
                points=corners.points[i : i + 1].clone(),
                covariance=corners.covariance[i : i + 1],
                board_points=corners.board_points[:1],
                valid=corners.valid[:1],
            ),
            config,
        )
        for name in FIELDS:
            assert torch.equal(getattr(alone, name)[0], getattr(found, name)[i]), name


@pytest.mark.parametrize("method", METHODS)
def test_one_problem_is_a_batch_of_shape_nothing(method):
    corners = thinned(simulate(THREE_TILTS[:2], batch=(2,)))
    config = CalibrationConfig(method=method, two_step_max_iterations=3)
    together = batch_of(corners, config)
    one = replace(
        corners,
        points=corners.points[1],
        covariance=corners.covariance[1],
        board_points=corners.board_points[1],
        valid=corners.valid[1],
    )
    result = calibrate(one.boards(), RIG, config)
    torch.testing.assert_close(result.motion.n, together.n[1], rtol=0, atol=1e-9)
    torch.testing.assert_close(result.motion.covariance, together.covariance[1], rtol=1e-5, atol=0)


def test_one_of_a_thousand_is_flagged_and_the_others_are_what_they_are_alone():
    small = thinned(simulate(THREE_TILTS[:2], batch=(1000,)))
    small.points[500, 1, 2] = math.nan
    found = batch_of(small)
    assert (found.info != Info.OK).nonzero().flatten().tolist() == [500]
    for i in (*range(0, 1000, 97), 499, 501, 999):
        alone = calibrate_batch(
            small.points[i], small.covariance[i], small.board_points[i], small.valid[i], CalibrationConfig()
        )
        for name in FIELDS:
            assert torch.equal(getattr(alone, name), getattr(found, name)[i]), name


def test_boards_of_different_size_and_missing_corners():
    boards = simulate().boards()
    first = replace(boards[0], valid=torch.arange(88) % 5 != 0)
    first = replace(first, points=torch.where(first.valid[:, None], first.points, torch.nan))
    cut = replace(
        boards[1], **{name: getattr(boards[1], name)[:40] for name in ("points", "covariance", "valid", "board_points")}
    )
    result = calibrate([first, cut, boards[2]], RIG, CalibrationConfig())
    assert [fit.corners for fit in result.boards] == [70, 40, 88]
    assert ((result.motion.n - true_motion()).abs() < 4 * result.motion.sigma).all()


def broken(change):
    boards = simulate(THREE_TILTS[:2]).boards()
    return [boards[0], replace(boards[1], **change(boards[1]))]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda b: {"valid": torch.arange(88) < 5}, "fewer than 6 valid corners"),
        (lambda b: {"valid": torch.arange(88) < 11}, "lie on one line"),
        (lambda b: {"points": b.points * math.nan}, "point is not finite"),
        (lambda b: {"covariance": b.covariance * math.nan}, "covariance is not finite"),
        (lambda b: {"covariance": b.covariance * 0.0}, "not positive definite"),
    ],
)
def test_bad_data_names_the_scan(change, reason):
    with pytest.raises(CalibrationError, match=f"scan_1: .*{reason}"):
        calibrate(broken(change), RIG, CalibrationConfig())


def test_no_boards():
    with pytest.raises(CalibrationError, match="no board scans"):
        calibrate([], RIG, CalibrationConfig())


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"prior_sigma": 0.0}, "prior_sigma"),
        ({"prior_sigma": math.inf}, "prior_sigma"),
        ({"rotation_sigma_rad": -1.0}, "rotation_sigma_rad"),
        ({"mounting_pitch_deg": 3.0, "mounting_pitch_sigma_deg": 0.0}, "mounting_pitch_sigma_deg"),
        ({"method": "joynt"}, "method"),
        ({"method": "two_step", "mounting_pitch_deg": 3.0}, "mounting_pitch_deg"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"process_sigma": -1.0}, "process_sigma"),
    ],
)
def test_options_out_of_range_are_named(options, name):
    with pytest.raises(ConfigError, match=rf"CalibrationConfig\.{name}: expected"):
        CalibrationConfig(**options)


def test_a_mounting_pitch_is_for_one_board():
    with pytest.raises(ConfigError, match=r"calibration\.mounting_pitch_deg: expected null"):
        calibrate(simulate(THREE_TILTS[:2]).boards(), RIG, CalibrationConfig(mounting_pitch_deg=3.0))
