"""What a calibration says of boards that do not fit, and sigmas that cover an unknown size of the board."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.estimation import nees
from lsvision.stages.calibration.calibrate import calibrate, calibrate_batch
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.scatter import widened
from tests.stages.calibration.boards import RIG
from tests.stages.calibration.contradictions import THREE, drifting_last, faster, other_size, shaken, sound


def said(corners, config=None):
    """The calibration of the first set."""
    names = ("points", "covariance", "board_points", "valid")
    boards = replace(corners, **{name: getattr(corners, name)[0] for name in names}).boards()
    return calibrate(boards, RIG, config or CalibrationConfig())


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


def test_speeds_are_named_relative_to_the_first_scan():
    result = said(faster(THREE, (1.00, 1.03, 1.06), 1))
    assert result.verdict == "inconsistent"
    (reason,) = result.reasons
    assert reason.startswith("scan scan_1 ran 3.00")
    assert "% faster, scan scan_2 ran " in reason
    assert reason.endswith("% faster than scan_0")


def test_the_one_scan_that_differs_is_named():
    (reason,) = said(faster(THREE, (1.00, 1.00, 0.97), 1)).reasons
    assert reason.startswith(("scan scan_2 ran 2.99", "scan scan_2 ran 3.00"))
    assert "% slower than scan_0 and scan_1" in reason


def test_a_drift_that_two_causes_explain_names_both():
    (reason,) = said(drifting_last(THREE, (0.0, 0.0, 0.01), 1)).reasons
    assert "mm per metre" in reason
    assert "scan scan_2" in reason
    assert "in depth" in reason


def test_the_size_of_the_squares_is_named():
    (reason,) = (r for r in said(other_size(sound(THREE, 1), 0.97)).reasons if "squares" in r and "board looks" in r)
    assert reason.startswith("the board looks 3.09")
    assert "% larger than its 29.1 mm squares: they measure 30 mm" in reason


def test_sound_boards_need_no_words():
    result = said(sound(THREE, 1))
    assert (result.verdict, result.reasons, result.notes) == ("determined", (), ())


def test_a_shake_is_a_note_and_no_contradiction_where_nothing_else_says_so():
    shake = shaken(sound(THREE, 1), 0.03, 97.0)
    assert said(shake).errors_along_scan
    assert (said(shake).verdict, said(shake).notes) == ("determined", ())
    result = said(shake, CalibrationConfig(correlated_odds=math.inf))
    assert result.reasons == ()
    (note,) = result.notes
    assert note.startswith("the corners of each line are displaced together by about 0.03 mm")


def batch(corners, **options):
    return calibrate_batch(
        corners.points, corners.covariance, corners.board_points, corners.valid, CalibrationConfig(**options)
    )


@pytest.mark.parametrize("method", [pytest.param("joint", marks=pytest.mark.slow), "least_squares"])
def test_an_unknown_size_of_the_board_is_covered_by_the_sigmas(method):
    sets = 200 if method == "joint" else 20
    corners = sound(THREE, sets)
    printed = other_size(corners, 1 / (1 + 1e-3 * torch.randn(sets, 1, 1, 1, dtype=torch.float64)))
    taken_as_exact = batch(printed, method=method)
    allowed_for = batch(printed, method=method, board_scale_sigma=1e-3)
    error = allowed_for.n - corners.n
    assert 2.4 < nees(error, torch.linalg.cholesky(allowed_for.covariance)).mean() < 3.7 or sets == 20
    assert (error.abs().mean(0)[1] < 0.1 * (taken_as_exact.n - corners.n).abs().mean(0)[1]).all()
    assert (allowed_for.noise_scale == 1).double().mean() > 0.95


def test_an_exact_size_costs_nothing_and_an_unknown_one_a_quarter_of_a_sigma_of_n2():
    corners = sound(THREE, 4)
    exact, unknown = batch(corners), batch(corners, board_scale_sigma=1.0)
    ratio = (unknown.covariance.diagonal(dim1=-2, dim2=-1) / exact.covariance.diagonal(dim1=-2, dim2=-1)).sqrt()
    assert ((ratio > 1) & (ratio < torch.tensor([1.01, 1.3, 1.01]))).all()


@pytest.mark.slow
def test_contradicting_scans_widen_the_sigmas_of_n():
    """n3 of one scan off by 0.01 hardly raises the chi-square of all corners, but moves n by many sigmas."""
    corners = drifting_last(THREE, (0.0, 0.0, 0.01), 50)
    found = batch(corners)
    assert (found.noise_scale < 4).all()
    assert nees(found.n - corners.n, torch.linalg.cholesky(found.covariance)).mean() < 10


def test_a_widened_covariance_stays_within_the_prior():
    covariance = torch.diag(torch.tensor([1e-10, 1e-9, 2.4e-3], dtype=torch.float64))
    wide = widened(covariance, torch.tensor(100.0, dtype=torch.float64), 0.05)
    torch.testing.assert_close(wide.diagonal()[:2], torch.tensor([1e-8, 1e-7]).double(), rtol=1e-3, atol=0)
    assert 2.4e-3 < wide[2, 2] < 2.5e-3
