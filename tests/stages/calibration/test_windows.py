"""What windows around corners make of a motion that bends the edges in them."""

import dataclasses
import math

import pytest
import torch

from lsvision.geometry import scan_position
from lsvision.stages.calibration.along_scan.kernels import Knots
from lsvision.stages.calibration.along_scan.lines import Lever, Travel
from lsvision.stages.calibration.along_scan.posterior import Processes
from lsvision.stages.calibration.along_scan.windows import Windows
from lsvision.stages.calibration.model import residuals_in_sigmas, rotations
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from tests.stages.calibration.boards import simulate
from tests.stages.calibration.test_edges import at_truth

TILTS = ((2.0, 1.5, 0.0), (-5.0, 1.0, 14.0), (1.0, -2.0, 40.0))
KNOTS = Knots(8, 16, 16)
HALF_MM = 6.0
WAVE_MM = 61.0


def wave(travel: torch.Tensor) -> torch.Tensor:
    """(δx, δz) of lines, mm, ``(*lines, 2)``."""
    angle = 2.0 * math.pi * travel / WAVE_MM
    return torch.stack([0.65 * torch.sin(angle), 0.4 * torch.cos(angle)], dim=-1)


def setting(sigma: float = 0.0) -> tuple[BoardProblem, torch.Tensor, Processes]:
    """Boards at the truth, and the waves as their errors along the scan."""
    torch.manual_seed(1)
    problem, state = at_truth(simulate(TILTS, sigma=(sigma,) * 3))
    travel = Travel.of(problem)
    moved = wave(travel.start_mm[:, None] + travel.extent_mm * KNOTS.place(problem.points))
    zero = torch.zeros_like(moved[..., 0])
    mean = torch.stack([moved[..., 0], zero, moved[..., 1], zero], dim=1)
    return problem, state, Processes(travel, Lever.of(problem), KNOTS, mean, mean[..., None])


def by_lines(problem: BoardProblem, state: torch.Tensor, board: int, corner: int) -> torch.Tensor:
    """(x, travel) where lines meet that are fitted to the bent edges of a corner, from where it is: step by step."""
    point, n = problem.points[board, corner], BoardState.split(state).n
    normals, offsets = [], []
    for axis in range(2):
        edge = scan_position(rotations(problem, state)[board, :, axis], n)[:2]
        step = torch.linspace(-HALF_MM, HALF_MM, 4001, dtype=torch.float64)[:, None] * edge / edge.abs().max()
        bent = wave(point[1] + step[:, 1]) - wave(point[1])
        normal = torch.stack([edge[1], -edge[0]]) / torch.linalg.vector_norm(edge)
        seen = step.clone()
        seen[:, 0] += bent[:, 0]
        normals.append(normal)
        offsets.append((seen @ normal).mean())
    return torch.linalg.solve(torch.stack(normals), torch.stack(offsets))


def test_corners_are_off_as_lines_through_bent_edges_meet():
    problem, state, processes = setting()
    only_x = processes.mean.clone()
    only_x[:, 2] = 0.0
    processes = dataclasses.replace(processes, mean=only_x)
    off = Windows.of(problem, state).displaced(processes, problem.points, HALF_MM)
    assert not off[..., 2].any()
    for board in range(len(TILTS)):
        for corner in (13, 40, 75):
            expected = by_lines(problem, state, board, corner)
            torch.testing.assert_close(off[board, corner, :2], expected, atol=2e-4, rtol=0)
    assert float(off[0, :, 1].abs().max()) < 1e-3  # edges across the travel lie still
    assert float(off[1, :, 1].abs().max()) > 5e-3


def test_depth_is_off_as_far_as_the_edges_along_the_travel_bend():
    problem, state, processes = setting()
    off = Windows.of(problem, state).displaced(processes, problem.points, HALF_MM)
    angle = 2.0 * math.pi * HALF_MM / WAVE_MM
    levelled = (math.sin(angle) / angle - 1.0) * wave(problem.points[0, :, 1])
    torch.testing.assert_close(off[0, :, ::2], levelled, atol=5e-4, rtol=0)


def test_the_windows_size_is_what_explains_the_residuals():
    problem, state, processes = setting(0.01)
    windows = Windows.of(problem, state)
    expected = windows.displaced(processes, problem.points, HALF_MM)
    seen = dataclasses.replace(problem, points=problem.points + expected)
    off = windows.off(processes, problem, residuals_in_sigmas(seen, state))
    assert float((off - expected).square().mean().sqrt()) < 0.1 * float(expected.square().mean().sqrt())


def test_corners_that_are_not_off_stay():
    problem, state, processes = setting(0.01)
    off = Windows.of(problem, state).off(processes, problem, residuals_in_sigmas(problem, state))
    assert float(off.square().mean().sqrt()) < 2e-3
    opposite = Windows.of(problem, state).off(processes, problem, -_far(problem, state, processes))
    assert not opposite.any()


def _far(problem: BoardProblem, state: torch.Tensor, processes: Processes) -> torch.Tensor:
    off = Windows.of(problem, state).displaced(processes, problem.points, HALF_MM)
    return torch.linalg.solve_triangular(problem.noise_chol, off[..., None], upper=False)[..., 0]


@pytest.mark.parametrize("valid", [False, True])
def test_corners_that_were_not_seen_are_nowhere_off(valid):
    problem, state, processes = setting(0.01)
    seen = problem.valid.clone()
    seen[0, 3] = valid
    problem = dataclasses.replace(problem, valid=seen)
    assert Windows.of(problem, state).spacing_mm == pytest.approx(30.0)
    off = Windows.of(problem, state).off(processes, problem, _far(problem, state, processes))
    assert bool(off[0, 3].any()) is valid


def test_the_spacing_is_that_of_neighbours_wherever_the_board_is_counted_from():
    """A matrix of distances has rounding errors on its diagonal."""
    problem, state, _ = setting()
    for shift in (0.0, 17.3, 211.7):
        counted = dataclasses.replace(problem, body_points=problem.body_points + shift)
        assert Windows.of(counted, state).spacing_mm == pytest.approx(30.0)
