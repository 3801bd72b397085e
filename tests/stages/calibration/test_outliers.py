"""Outlying corners are found, named, left out and cost no accuracy; corners that are merely noisier are kept."""

from dataclasses import replace

import pytest
import torch

from lsvision.estimation import nees
from lsvision.stages.calibration.calibrate import calibrate, calibrate_batch
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.outliers import outlying
from tests.stages.calibration.boards import RIG, simulate, with_vibration
from tests.stages.calibration.contradictions import (
    DETECTED,
    EIGHT,
    THREE,
    noisier_than_stated,
    one_corner_off,
    rows_exchanged,
    sound,
    with_outliers,
)


def calibrated(corners):
    return calibrate_batch(corners.points, corners.covariance, corners.board_points, corners.valid, CalibrationConfig())


def left_out(corners):
    return outlying(corners.problem()[0])


@pytest.mark.parametrize("sets", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_sound_corners_are_kept_whatever_their_noise(sets):
    torch.manual_seed(0)
    for corners in (
        sound(THREE, sets),
        noisier_than_stated(THREE, sets, 2.0),
        with_vibration(sound(THREE, sets), 0.88),
    ):
        assert left_out(corners).double().mean() < 1e-4


@pytest.mark.parametrize("sets", [60, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("factor", [10.0, 100.0])
def test_outliers_change_the_errors_by_less_than_a_tenth(factor, sets):
    """The same noise with and without: of errors that are large beside the noise none is left."""
    torch.manual_seed(1)
    clean = sound(THREE, sets)
    with_some = with_outliers(clean, 0.02, factor)
    without, found = calibrated(clean), calibrated(with_some)
    rms = [(result.n - clean.n).square().sum(0).sqrt() for result in (without, found)]
    assert (rms[1] < 1.1 * rms[0]).all()
    large = ((with_some.points - clean.points) / torch.tensor((0.02, 0.02, 0.014))).abs().amax(-1) > 8
    off = left_out(with_some)
    assert (off & large).sum() >= 0.99 * large.sum()
    assert (off & (with_some.points == clean.points).all(-1)).sum() <= 1e-4 * off.numel()


@pytest.mark.slow
@pytest.mark.parametrize("tilts", [THREE, EIGHT])
@pytest.mark.parametrize("kind", ["matched", "doubled", "outliers at 10", "outliers at 100"])
def test_errors_are_as_large_as_their_sigmas(kind, tilts):
    torch.manual_seed(2)
    corners = noisier_than_stated(tilts, 400, 2.0) if kind == "doubled" else sound(tilts, 400)
    if kind.startswith("outliers"):
        corners = with_outliers(corners, 0.02, float(kind.split()[-1]))
    found = calibrated(corners)
    assert 2.5 < nees(found.n - corners.n, torch.linalg.cholesky(found.covariance)).mean() < 3.6


@pytest.mark.parametrize("sets", [4, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rows", [(3, 4), (0, 1), (0, 7), (2, 6)])
def test_exchanged_rows_are_found(rows, sets):
    torch.manual_seed(3)
    corners = rows_exchanged(sound(THREE, sets), *rows)
    found = left_out(corners)[:, 1].unflatten(-1, (8, 11))
    expected = torch.zeros_like(found)
    expected[:, list(rows)] = True
    assert (found == expected).all((-2, -1)).double().mean() >= 0.95


@pytest.mark.parametrize("sets", [4, pytest.param(200, marks=pytest.mark.slow)])
def test_one_corner_a_square_off_is_the_one_left_out(sets):
    torch.manual_seed(4)
    clean = sound(THREE, sets)
    corners = one_corner_off(clean)
    assert ((left_out(corners) == (corners.points != clean.points).any(-1)).all((-2, -1))).double().mean() >= 0.95
    assert ((calibrated(corners).n - calibrated(clean).n).abs().amax(0) < torch.tensor([1e-5, 1e-5, 5e-5])).all()


def one_set(corners):
    """Boards of the first set."""
    names = ("points", "covariance", "board_points", "valid")
    return replace(corners, **{name: getattr(corners, name)[0] for name in names}).boards()


@pytest.mark.parametrize("sigma", [(0.02, 0.02, 0.014), DETECTED])
def test_the_corner_is_named_with_the_place_where_it_lies(sigma):
    torch.manual_seed(5)
    result = calibrate(one_set(one_corner_off(sound(THREE, 1, sigma))), RIG, CalibrationConfig())
    assert result.verdict == "determined"
    (note,) = result.notes
    assert note.startswith("scan scan_1: the corner in column 6, row 1 lies ")
    assert note.endswith(" mm off, at the place of column 7, row 1; it was left out")
    assert result.boards[1].outliers == ((6, 1),)
    assert [fit.corners for fit in result.boards] == [88, 87, 88]
    assert all(fit.largest_residual < 6 for fit in result.boards)


def test_exchanged_rows_make_a_calibration_inconsistent():
    torch.manual_seed(6)
    result = calibrate(one_set(rows_exchanged(sound(THREE, 1), 2, 5)), RIG, CalibrationConfig())
    assert result.verdict == "inconsistent"
    assert result.reasons == ("scan scan_1: rows 3 and 6 of its corners are exchanged; their 22 corners were left out",)


def test_many_outliers_make_a_board_doubtful():
    torch.manual_seed(7)
    boards = one_set(sound(THREE, 1))
    points = boards[0].points.clone()
    points[::6] += 2.0 * torch.randn(15, 3, dtype=torch.float64)
    result = calibrate([replace(boards[0], points=points), *boards[1:]], RIG, CalibrationConfig())
    assert result.verdict == "inconsistent"
    assert "scan_0: 15 of 88 corners lie off their board and were left out" in result.reasons[0]
    assert len(result.boards[0].outliers) == 15


def test_batch_equals_loop():
    torch.manual_seed(8)
    corners = with_outliers(sound(THREE, 6), 0.02, 30.0)
    together = left_out(corners)
    for i in range(6):
        names = ("points", "covariance", "board_points", "valid")
        alone = replace(corners, **{name: getattr(corners, name)[i : i + 1] for name in names})
        assert torch.equal(left_out(alone)[0], together[i])


def test_unseen_corners_are_never_outlying():
    corners = simulate(batch=(2,))
    valid = corners.valid.clone()
    valid[:, 0, ::3] = False
    points = torch.where(valid[..., None], corners.points, 1e6)
    points[:, 0, 1] += 5.0
    off = left_out(replace(corners, points=points, valid=valid))
    assert off.nonzero().tolist() == [[0, 0, 1], [1, 0, 1]]


@pytest.mark.parametrize("wavelength_mm", [61.0, 233.0, 480.0])
def test_a_line_that_is_displaced_as_a_whole_is_no_outlier(wavelength_mm):
    torch.manual_seed(9)
    corners = sound(THREE, 20)
    travel = corners.points[..., 1:2]
    swing = 0.3 * 2**0.5 * torch.sin(2 * torch.pi * travel / wavelength_mm)
    shaken = replace(corners, points=corners.points + swing * torch.tensor([1.0, 0.0, 1.0]))
    assert left_out(shaken).double().mean() < 1e-3
