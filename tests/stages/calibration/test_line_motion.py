"""The motion from line to line of board scans: its posterior, its gauge, and what it does to the result."""

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import pad

from lsvision.errors import CalibrationError
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.geometry import middle_point, shaken, steadied, without_trend
from lsvision.stages.calibration.along_scan import Linearised, Spectrum, processes_given_corners
from lsvision.stages.calibration.along_scan.kernels import FINE, covariance_of, kernel_family
from lsvision.stages.calibration.along_scan.lines import Travel, directions, latents
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.known_motion import calibrate_lines
from lsvision.stages.calibration.methods import joint
from lsvision.types import BoardEdges
from tests.stages.calibration.boards import FOUR_TILTS, RIG, SIGMA, Corners, simulate
from tests.stages.calibration.edges import with_lines
from tests.stages.calibration.test_correlated import small_problem

SHARP = (0.004, 0.004, 0.004)
PIVOT = middle_point(RIG)


def wave(travel: torch.Tensor, wavelengths: tuple[float, ...], rms: float) -> torch.Tensor:
    """A sum of waves of equal size and random phases, of some rms; the phases of each board differ."""
    waves = [
        torch.sin(2 * math.pi * (travel / length + torch.rand(*travel.shape[:-1], 1, dtype=torch.float64)))
        for length in wavelengths
    ]
    return rms * math.sqrt(2 / len(waves)) * torch.stack(waves).sum(0)


def vibrating(corners: Corners, motions) -> Corners:
    """Corners that lines show which are displaced and rolled by ``motions(travel)``, ``(boards, corners, 4)``."""
    points = corners.points.clone()
    points[..., ::2] = shaken(points[..., ::2], motions(points[..., 1]), PIVOT)
    return dataclasses.replace(corners, points=points)


def shaken_boards(seed: int, wavelengths=(150.0,), tilts=FOUR_TILTS):
    """Boards under vibration of x, z and roll, and the true motion of their lines."""
    torch.manual_seed(seed)
    corners = simulate(tilts, sigma=SHARP)
    phases = torch.random.get_rng_state()

    def motion(travel):
        torch.random.set_rng_state(phases)  # the same phases for corners and lines
        parts = [wave(travel, wavelengths, size) for size in (0.3, 0.3, 3e-4)]
        return pad(torch.stack(parts, dim=-1), (0, 1))

    moved = vibrating(corners, motion)
    boards = with_lines(moved, 0.5)
    longest = max(len(board.travel_mm) for board in boards)
    lines = torch.stack([pad(board.travel_mm, (0, longest - len(board.travel_mm))) for board in boards])
    truth = motion(lines)
    return corners, boards, [truth[i, : len(board.travel_mm)] for i, board in enumerate(boards)]


def test_processes_are_those_of_a_dense_gaussian_regression():
    problem, start = small_problem()
    state = joint(problem, start, CalibrationConfig()).mean
    linearised = Linearised.of(problem, state, prior_sigma=0.05)
    variances = torch.zeros(4, len(kernel_family().log_prior), dtype=torch.float64)
    variances[0, 3], variances[2, 13], variances[3, 4] = 0.01, 0.02, 0.005
    found = processes_given_corners(problem, linearised, Spectrum.of_kernels(variances))

    roots = covariance_root(covariance_of(variances, FINE))
    moved = latents(problem, roots[None], FINE)
    boards, corners = problem.valid.shape
    rows, right, noise = [], [], []
    for board in range(boards):
        for corner in range(corners):
            if problem.valid[board, corner]:
                by_pose = torch.zeros(3, 6 * boards, dtype=torch.float64)
                by_pose[:, 6 * board : 6 * board + 6] = linearised.columns[board, corner, :, :6]
                by_process = torch.zeros(3, boards * moved.shape[-1], dtype=torch.float64)
                by_process[:, board * moved.shape[-1] : (board + 1) * moved.shape[-1]] = moved[board, corner]
                rows.append(torch.cat([by_process, by_pose, linearised.columns[board, corner, :, 6:9]], -1))
                right.append(linearised.columns[board, corner, :, 9])
                noise.append(problem.noise_chol[board, corner])
    A = torch.cat([torch.linalg.solve(chol, row) for chol, row in zip(noise, rows, strict=True)])
    r = torch.cat([torch.linalg.solve(chol, row) for chol, row in zip(noise, right, strict=True)])
    information = A.mT @ A
    count = boards * moved.shape[-1]
    information[:count, :count] += torch.eye(count).double()
    information[-3:, -3:] += linearised.prior[:, :3].mT @ linearised.prior[:, :3]
    gradient = A.mT @ r
    gradient[-3:] += linearised.prior[:, :3].mT @ linearised.prior[:, 3]
    scale = information.diagonal().rsqrt()
    covariance = scale[:, None] * torch.linalg.inv(scale[:, None] * information * scale) * scale
    mean = (covariance @ gradient)[:count].unflatten(0, (boards, 4, -1))
    at_knots = (roots @ mean[..., None])[..., 0]
    torch.testing.assert_close(found.mean, at_knots, rtol=1e-5, atol=1e-7)
    one = covariance[:count, :count].unflatten(0, (boards, -1)).unflatten(-1, (boards, -1))
    for board in range(boards):
        spread = torch.block_diag(*roots) @ one[board, :, board] @ torch.block_diag(*roots).mT
        ours = found.factor[board].flatten(0, 1)
        torch.testing.assert_close(ours @ ours.mT, spread, rtol=1e-5, atol=1e-8)


def test_corners_are_displaced_as_their_lines_are():
    problem, start = small_problem()
    linearised = Linearised.of(problem, start, prior_sigma=0.05)
    variances = torch.full((4, len(kernel_family().log_prior)), 1e-4, dtype=torch.float64)
    found = processes_given_corners(problem, linearised, Spectrum.of_kernels(variances))
    weights = Travel.of(problem).weights(problem, FINE)
    expected = ((weights @ found.mean.mT)[..., None] * directions(problem)).sum(-2)
    seen = problem.valid
    torch.testing.assert_close(found.displaced(problem.points)[seen], expected[seen])


def test_lines_lie_where_they_were_displaced_to():
    _, boards, truth = shaken_boards(1)
    result = calibrate(boards, RIG, CalibrationConfig())
    assert result.verdict == "determined"
    assert result.rmse_after_mm < 0.01
    ratios = []
    for board, motion, true in zip(boards, result.line_motions, truth, strict=True):
        states = {finding.component: finding.state for finding in motion.findings}
        assert states == {"dx": "corrected", "dz": "corrected", "roll": "corrected", "dy": "absent"}
        assert not motion.dy_mm.any()
        level = without_trend(board.travel_mm)
        error = (level(motion.values.T) - level(true.T)).T[:, :3]
        on_board = (board.travel_mm >= board.points[:, 1].min()) & (board.travel_mm <= board.points[:, 1].max())
        assert float(error[on_board, :2].square().mean().sqrt()) < 0.03
        ratios.append((error / motion.sigma[:, :3])[on_board])
        torch.testing.assert_close(motion.values.mean(0), torch.zeros(4).double(), atol=1e-9, rtol=0)
    assert float(torch.cat(ratios).square().mean().sqrt()) == pytest.approx(1.0, abs=0.5)


def test_scans_are_straight_once_their_lines_are_steadied():
    """Not only up to a trend: all boards fit one n."""
    _, boards, _ = shaken_boards(2)
    result = calibrate(boards, RIG, CalibrationConfig())
    steady = []
    for board, motion in zip(boards, result.line_motions, strict=True):
        line = (board.points[:, 1] - board.travel_mm[0]) / (board.travel_mm[1] - board.travel_mm[0])
        points = board.points.clone()
        points[:, ::2] = steadied(points[:, ::2], motion.at(line), PIVOT)
        steady.append(dataclasses.replace(board, points=points))
    again = calibrate(steady, RIG, CalibrationConfig(line_motion="none", correlated_odds=math.inf))
    assert again.rmse_after_mm < 0.02
    assert float((again.motion.n - result.motion.n).abs().max()) < 5e-5


def test_a_still_scan_gives_the_same_bits_with_and_without():
    torch.manual_seed(3)
    boards = with_lines(simulate(FOUR_TILTS, sigma=SIGMA), 0.5)
    auto, none = (calibrate(boards, RIG, CalibrationConfig(line_motion=choice)) for choice in ("auto", "none"))
    assert auto.line_motions == () == none.line_motions
    assert torch.equal(auto.motion.n, none.motion.n)
    assert torch.equal(auto.motion.covariance, none.motion.covariance)
    assert auto.iterations == none.iterations


def test_line_motion_is_reported_where_it_is_asked_for():
    _, boards, _ = shaken_boards(4)
    auto, none = (calibrate(boards, RIG, CalibrationConfig(line_motion=choice)) for choice in ("auto", "none"))
    assert torch.equal(auto.motion.n, none.motion.n)
    assert none.line_motions == ()
    assert none.rmse_after_mm > 10 * auto.rmse_after_mm
    assert all(board.reduced_chi_square < 1.5 for board in auto.boards)
    paper = calibrate(boards[:1], RIG, CalibrationConfig(method="two_step"))
    assert paper.line_motions == ()
    assert paper.rmse_after_mm > 0.1


def test_lines_of_a_board_whose_motion_is_known():
    corners, boards, truth = shaken_boards(5, tilts=FOUR_TILTS[1:2])
    found = calibrate_lines(boards[0], None, corners.n, RIG, CalibrationConfig())
    assert found.rmse_after_mm < 0.01 < 0.1 < found.rmse_before_mm
    torch.testing.assert_close(found.motion.n, torch.tensor([0.0, 1.0, 0.0]).double(), atol=1e-6, rtol=0)
    level = without_trend(boards[0].travel_mm)
    off = level(found.line_motions[0].values.T[:2]) - level(truth[0].T[:2])
    assert float(off.square().mean().sqrt()) < 0.05


def test_a_known_motion_stretches_the_travel_between_the_cameras_of_a_raw_pair(monkeypatch):
    """Taken to where the object moved nominally, the right camera sees an edge later by n2 times as much."""
    corners, boards, _ = shaken_boards(5, tilts=FOUR_TILTS[1:2])
    points = torch.rand(7, 3, dtype=torch.float64)
    numbers, square = torch.arange(7), torch.eye(2, dtype=torch.float64).expand(7, 2, 2)
    edges = BoardEdges("s", points, square, points[:, 0], points, points, numbers, numbers, later_mm=points[:, 1])
    given = []

    def calibrated(corners, rig, config, edges):
        given.extend(edges)
        raise CalibrationError("enough is known")

    monkeypatch.setattr("lsvision.stages.calibration.known_motion.calibrate", calibrated)
    for seen in (edges, dataclasses.replace(edges, later_mm=None)):
        with pytest.raises(CalibrationError, match="enough"):
            calibrate_lines(boards[0], seen, corners.n, RIG, CalibrationConfig())
    torch.testing.assert_close(given[0].later_mm, corners.n[1] * edges.later_mm)
    assert given[1].later_mm is None
