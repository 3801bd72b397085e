"""Edges of squares on every line: their rows, the errors along the scan that they show, and what they do to n."""

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import pad

from lsvision.geometry import middle_point, scan_position, shaken, transform, without_trend
from lsvision.stages.calibration.along_scan import Travel, edge_rows
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from tests.stages.calibration.boards import FOUR_TILTS, RIG, Corners, simulate
from tests.stages.calibration.edges import COLUMN_SIGMA, DISPARITY_SIGMA, Motion, edges_of, with_lines

PIVOT = middle_point(RIG)
SIZES = (0.3, 0.3, 3e-4)  # of x and z, mm, and roll
TWO_TILTS = ((2.0, 1.5, 0.0), (-5.0, 1.0, 6.0))


def vibration(boards: int, wavelengths: torch.Tensor) -> Motion:
    """Sines of the wavelengths ``(components, waves)``, of equal size, with other phases on every board."""
    phase = 2 * math.pi * torch.rand(boards, *wavelengths.shape, dtype=torch.float64)
    size = torch.tensor(SIZES, dtype=torch.float64) * math.sqrt(2 / wavelengths.shape[-1])

    def motion(travel: torch.Tensor) -> torch.Tensor:
        waves = torch.sin(2 * math.pi * travel[..., None, None] / wavelengths + phase[: len(travel), None])
        return pad(size * waves.sum(-1), (0, 1))

    return motion


def shaken_boards(seed: int, tilts=FOUR_TILTS) -> tuple[Corners, Motion]:
    """Corners under vibrations of three wavelengths in each component, and the motion of their lines."""
    torch.manual_seed(seed)
    motion = vibration(len(tilts), torch.tensor([[61.0, 97.0, 233.0]] * 3, dtype=torch.float64))
    corners = simulate(tilts, sigma=(0.005, 0.005, 0.005))
    points = corners.points.clone()
    points[..., ::2] = shaken(points[..., ::2], motion(points[..., 1]), PIVOT)
    return dataclasses.replace(corners, points=points), motion


def at_truth(corners: Corners) -> tuple[BoardProblem, torch.Tensor]:
    """The problem about the true poses, and the true state."""
    problem, _ = corners.problem()
    problem = dataclasses.replace(problem, rotation=corners.rotation)
    position = transform(corners.rotation, corners.translation, problem.centroid[:, None])[:, 0]
    return problem, BoardState(torch.zeros_like(position), position, corners.n).join()


def still(travel: torch.Tensor) -> torch.Tensor:
    return travel.new_zeros(*travel.shape, 4)


def test_rows_vanish_at_the_true_map_but_for_the_noise():
    """And they do where points are taken for others of the same edge: its direction says nothing."""
    torch.manual_seed(1)
    corners = simulate(TWO_TILTS, sigma=(0.0, 0.0, 0.0))
    edges = edges_of(corners, still)
    along = [
        scan_position(transform(corners.rotation[i], corners.translation[i], edge.stop), corners.n)
        - scan_position(transform(corners.rotation[i], corners.translation[i], edge.start), corners.n)
        for i, edge in enumerate(edges)
    ]
    slid = [
        dataclasses.replace(edge, points=edge.points + 1e-3 * direction)
        for edge, direction in zip(edges, along, strict=True)
    ]
    problem, state = at_truth(corners)
    placed = BoardState.split(state)
    true_map = torch.cat([placed.position[:, None], corners.rotation.mT], dim=1)
    coefficients = scan_position(true_map, corners.n).flatten(-2)
    rows = edge_rows(problem, state, slid)
    error = rows.rows[..., -1] - (rows.rows[..., -13:-1] @ coefficients[..., None])[..., 0]
    freedom = rows.rows.any(-1).sum(-1)
    assert rows.values == freedom.sum()
    ratio = error.square().sum(-1) / freedom
    assert bool(((ratio > 0.7) & (ratio < 1.3)).all()), ratio
    torch.testing.assert_close(rows.sigma_px[:, 0], torch.full((2,), COLUMN_SIGMA).double(), rtol=0.1, atol=0)
    torch.testing.assert_close(rows.sigma_px[:, 1], torch.full((2,), DISPARITY_SIGMA).double(), rtol=0.1, atol=0)


def test_edges_beyond_the_corners_that_were_used_do_not_count():
    corners, motion = shaken_boards(1, TWO_TILTS)
    valid = corners.valid.clone()
    valid[0, :11] = False  # a whole row
    fewer = dataclasses.replace(corners, valid=valid)
    edges = edges_of(corners, motion)
    problem, state = at_truth(fewer)
    first = problem.points[0, valid[0], 1].min()
    within = edges[0].points[:, 1] >= first
    assert not bool(within.all())
    kept = {name: getattr(edges[0], name)[within] for name in ("points", "by_column", "sigma_px", "start", "stop")}
    kept |= {name: getattr(edges[0], name)[within] for name in ("segment", "line")}
    all_rows, some_rows = (
        edge_rows(problem, state, [edge, edges[1]]).rows for edge in (edges[0], dataclasses.replace(edges[0], **kept))
    )
    torch.testing.assert_close(all_rows.mT @ all_rows, some_rows.mT @ some_rows, rtol=1e-6, atol=1e-3)


def test_edges_far_off_their_board_do_not_count():
    corners, motion = shaken_boards(2, TWO_TILTS)
    problem, state = at_truth(corners)
    edges = edges_of(corners, motion)
    clean = edge_rows(problem, state, edges)
    wrong = torch.zeros(len(edges[0].line), dtype=torch.bool)
    wrong[::50] = True
    points = torch.where(wrong[:, None], edges[0].points + torch.tensor([1.0, 0.0, 0.5]).double(), edges[0].points)
    spoiled = edge_rows(problem, state, [dataclasses.replace(edges[0], points=points), edges[1]])
    torch.testing.assert_close(spoiled.sigma_px, clean.sigma_px, rtol=0.1, atol=0)


def test_errors_that_last_along_an_edge_weigh_less():
    torch.manual_seed(3)
    corners = simulate(TWO_TILTS, sigma=(0.0, 0.0, 0.0))
    problem, state = at_truth(corners)
    edges = edges_of(corners, still)
    noise = torch.randn(len(edges[0].line) + 3, dtype=torch.float64)
    lasting = 0.03 * (noise[3:] + noise[2:-1] + noise[1:-2] + noise[:-3]) / 2  # over four lines
    moved = edges[0].points.clone()
    moved[:, ::2] += (edges[0].by_column @ torch.stack([lasting, torch.zeros_like(lasting)], -1)[..., None])[..., 0]
    rows = edge_rows(problem, state, [dataclasses.replace(edges[0], points=moved), edges[1]])
    lost = rows.rows.square().sum((-2, -1))
    assert 0.1 < float(lost[0] / lost[1]) < 0.8


@pytest.mark.slow
def test_edges_show_every_line_and_sharpen_n():
    ratios, distances = [], []
    for seed in (5, 6):
        corners, motion = shaken_boards(seed)
        boards = with_lines(corners)
        result = calibrate(boards, RIG, CalibrationConfig(), edges_of(corners, motion))
        alone = calibrate(boards, RIG, CalibrationConfig())
        assert result.verdict == "determined"
        assert result.rmse_after_mm < 0.012
        assert float(result.motion.sigma[0]) < 0.7 * float(alone.motion.sigma[0])
        error = result.motion.n - corners.n
        distances.append(float(error @ torch.linalg.solve(result.motion.covariance, error)))
        for index, (board, lines) in enumerate(zip(boards, result.line_motions, strict=True)):
            true = motion(board.travel_mm.expand(len(boards), -1))[index]
            level = without_trend(board.travel_mm)
            off = (level(lines.values.T) - level(true.T)).T[:, :3]
            on_board = (board.travel_mm > board.points[:, 1].min()) & (board.travel_mm < board.points[:, 1].max())
            assert float(off[on_board, :2].square().mean().sqrt()) < 0.06
            ratios.append((off / lines.sigma[:, :3]).square().mean())
    assert 0.5 < float(torch.stack(ratios).mean().sqrt()) < 1.5
    assert max(distances) < 14.2  # 1 in 400


def test_still_boards_take_no_notice_of_edges():
    torch.manual_seed(7)
    corners = simulate(TWO_TILTS)
    boards = with_lines(corners)
    plain = calibrate(boards, RIG, CalibrationConfig())
    with_edges = calibrate(boards, RIG, CalibrationConfig(), edges_of(corners, still))
    assert torch.equal(plain.motion.n, with_edges.motion.n)
    assert torch.equal(plain.motion.covariance, with_edges.motion.covariance)


def test_scans_without_edges_are_solved_by_their_corners():
    corners, _ = shaken_boards(8)
    boards = with_lines(corners)
    plain = calibrate(boards, RIG, CalibrationConfig())
    without = calibrate(boards, RIG, CalibrationConfig(), [None] * len(boards))
    assert torch.equal(plain.motion.n, without.motion.n)
    for ours, theirs in zip(plain.line_motions, without.line_motions, strict=True):
        assert torch.equal(ours.values, theirs.values)


def test_the_right_camera_sees_a_motion_when_it_looks():
    """A crossing whose partner is seen two millimetres later: two moments of the vibration, one of the edge."""
    corners, motion = shaken_boards(0, TWO_TILTS)
    problem, state = at_truth(corners)
    edges = edges_of(corners, motion, later_mm=2.0)
    known = edge_rows(problem, state, edges).sigma_px
    expected = torch.tensor([COLUMN_SIGMA, DISPARITY_SIGMA], dtype=torch.float64).expand(2, -1)
    torch.testing.assert_close(known, expected, rtol=0.1, atol=0)
    at_once = edge_rows(problem, state, [dataclasses.replace(found, later_mm=None) for found in edges]).sigma_px
    assert float((at_once / known)[:, 0].min()) > 1.3


def test_crossings_that_the_right_camera_saw_beyond_the_knots_say_nothing():
    """Beyond the corners no knot says what the object did."""
    corners, motion = shaken_boards(0, TWO_TILTS)
    problem, state = at_truth(corners)
    edges = edges_of(corners, motion, later_mm=8.0)
    inside, end = [], (Travel.of(problem).start_mm + Travel.of(problem).extent_mm).tolist()
    for found, last in zip(edges, end, strict=True):
        kept = found.points[:, 1] + found.later_mm <= last
        values = {item.name: getattr(found, item.name) for item in dataclasses.fields(found)}
        cut = {name: value[kept] for name, value in values.items() if isinstance(value, torch.Tensor)}
        inside.append(dataclasses.replace(found, **cut))
    grams = [(rows := edge_rows(problem, state, some).rows).mT @ rows for some in (edges, inside)]
    assert sum(len(found.line) for found in inside) < sum(len(found.line) for found in edges)
    torch.testing.assert_close(grams[0], grams[1], rtol=1e-6, atol=1e-6 * float(grams[1].abs().max()))
