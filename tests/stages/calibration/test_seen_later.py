"""Corners that the right camera of a raw pair sees later: what the motion in between does to what they measure."""

from dataclasses import replace

import torch

from lsvision.geometry import project, triangulate
from lsvision.stages.calibration.along_scan import FINE, Lever, Processes, Travel
from lsvision.stages.calibration.along_scan.seen_later import SeenLater
from lsvision.types import BoardCorners
from tests.stages.calibration.boards import RIG

BOARDS, CORNERS = 2, 30


def processes(points: torch.Tensor) -> Processes:
    """A wave in x, z and roll at the knots over boards of 200 mm."""
    travel = Travel(torch.tensor([0.0, 10.0]).double(), torch.tensor(200.0).double())
    place = travel.start_mm[:, None] + travel.extent_mm * FINE.place(points)
    waves = [0.3 * torch.sin(place / 12.0), 0.0 * place, 0.2 * torch.cos(place / 15.0), 0.05 * torch.sin(place / 20.0)]
    seen = torch.ones(points.shape[:-1], dtype=torch.bool)
    mean = torch.stack(waves, dim=1)
    return Processes(travel, Lever.about(points, seen), FINE, mean, mean[..., None])


def boards(later: torch.Tensor | None) -> list[BoardCorners]:
    """Boards of which nothing but the moment counts."""
    points, square = torch.rand(CORNERS, 3).double(), torch.eye(3).double().expand(CORNERS, 3, 3)
    board = BoardCorners("s", points, square, torch.ones(CORNERS).bool(), points, points[:, :2])
    return [board, replace(board, later_mm=later)]


def test_a_corner_is_measured_where_the_rays_of_both_moments_meet():
    points = torch.rand(BOARDS, CORNERS, 3, dtype=torch.float64)
    points = torch.tensor([-40.0, 20.0, 790.0]) + torch.tensor([300.0, 150.0, 20.0]) * points
    moved = processes(points)
    later = torch.tensor([2.0, -1.5], dtype=torch.float64)[:, None] * torch.rand(BOARDS, CORNERS, dtype=torch.float64)
    zero = torch.zeros_like(later)
    at_once = points + moved.displaced(points)
    then = points + moved.displaced(points + torch.stack([zero, later, zero], dim=-1))
    left = project(RIG, at_once[..., 0], at_once[..., 2])[0]
    right = project(RIG, then[..., 0], then[..., 2])[1]
    x, z = triangulate(RIG, left, left - right)
    off = SeenLater(later, RIG).off(moved, points)
    expected = torch.stack([x - at_once[..., 0], zero, z - at_once[..., 2]], dim=-1)
    torch.testing.assert_close(off, expected, rtol=0.01, atol=1e-4)
    assert float(off.abs().max()) > 0.02


def test_boards_that_both_cameras_see_at_once_need_nothing():
    assert SeenLater.of(boards(None), RIG) is None
    later = torch.full((CORNERS,), 1.5, dtype=torch.float64)
    later[3] = torch.nan  # not seen
    found = SeenLater.of(boards(later), RIG)
    assert not found.later_mm[0].any()
    assert float(found.later_mm[1].sum()) == 1.5 * (CORNERS - 1)
