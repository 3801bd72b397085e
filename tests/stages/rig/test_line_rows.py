"""Rows on the motion of the lines: what corners are displaced by, each camera's on its own line, in their windows."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lsvision.stages.calibration.along_scan import FINE
from lsvision.stages.rig.line_rows import LineRows
from lsvision.stages.rig.model import Shared
from lsvision.stages.rig.seen_motion import SeenMotion
from lsvision.stages.rig.sightings import Sightings
from lsvision.stages.rig.solve import RigSolution, solve_rig
from lsvision.study.rig_scans import RigConditions
from lsvision.study.shaken import Vibration
from lsvision.study.shaken_rigs import ShakenBoards
from tests.stages.rig.boards import BOARD, CONFIG, DATA_SHEET, PRIOR, Truth

EXACT = RigConditions(boards=4, column_sigma_px=1e-6, line_sigma=1e-6)
RMS, WAVE_MM = 1e-3, 120.0  # so small that all is linear


@dataclass(frozen=True)
class Case:
    """A rig found on still boards, what it sees of the same boards when they shake, and the motion."""

    solution: RigSolution
    still: Sightings
    shaken: Sightings
    motion: Vibration


def case(size: tuple[float, float, float]) -> Case:
    """Boards whose motion has a size of x, z, mm, and roll, rad; the planes of view are millimetres apart."""
    torch.manual_seed(3)
    truth = Truth.drawn(1)
    truth.quantities[0, 11] = 2.5
    chance = torch.Generator().manual_seed(4)
    sightings = []
    for rms in (0.0, RMS):
        chance.manual_seed(4)
        motion = Vibration.drawn(tuple(rms * part for part in size), (WAVE_MM,), EXACT.boards, chance)
        torch.manual_seed(5)
        boards = ShakenBoards.placed(DATA_SHEET, Shared(truth.quantities[0], truth.n[0]), BOARD, EXACT, motion)
        sightings.append(boards.sightings(EXACT))
    return Case(solve_rig(sightings[0], PRIOR, CONFIG), *sightings, motion)


def values(lines: LineRows, motion: Vibration) -> Tensor:
    """The motion at the knots, mm, component by component: roll about the corners' middle."""
    place = FINE.place(lines.residuals)
    travel = lines.travel.start_mm[:, None] + lines.travel.extent_mm * place
    by_board = torch.stack([motion.at(board, along) for board, along in enumerate(travel)])
    dx, dz, roll, dy = by_board.unbind(-1)
    points, pair = SeenMotion.of(lines.solution).points, lines.solution.pair
    off = points.mean(1) - pair.middle
    across = (points - points.mean(1, keepdim=True))[..., ::2]
    rms = (across.square().sum((-3, -2, -1)) / lines.seen.sum()).sqrt()
    return torch.stack([dx + off[:, 2:] * roll, dy, dz - off[:, :1] * roll, rms * roll], dim=1)


def test_rows_are_what_a_motion_displaces_the_corners_by():
    """Both cameras see one of 2.5 mm apart; in sigmas as stated, which here are 1e-6 px and 7e-8 mm."""
    for size in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1e-3), (1.0, 0.5, 2e-3)):
        one = case(size)
        lines, shaken = (LineRows.of(one.solution, sightings) for sightings in (one.still, one.shaken))
        moved = (shaken.residuals - lines.residuals).flatten(1)
        rows = torch.einsum("brck,bck->br", lines.by_knots(lines.seen, 0.0), values(lines, one.motion))
        columns = moved.unflatten(1, (-1, 2))[..., 0]
        torch.testing.assert_close(
            rows.unflatten(1, (-1, 2))[..., 0], columns, atol=0.01 * float(columns.abs().max()), rtol=0
        )


def test_corners_that_were_left_out_have_no_rows():
    one = case((1.0, 1.0, 1e-3))
    lines = LineRows.of(one.solution, one.still)
    kept = lines.seen.clone()
    kept[1, 3] = False
    rows = lines.by_knots(kept, 0.1).unflatten(1, (-1, 4))
    assert not rows[1, 3].any()
    assert bool(rows[1, 4].any())


def test_a_window_levels_the_motion_along_both_edges():
    """Against where straight lines meet that pass where their edges were in the mean of the window's lines."""
    one, share = case((1.0, 1.0, 1e-3)), 0.2
    lines = LineRows.of(one.solution, one.still)
    at, columns = values(lines, one.motion), BOARD.inner[0]
    nodes, weights = np.polynomial.legendre.leggauss(6)
    rows = torch.einsum("brck,bck->br", lines.by_knots(lines.seen, share), at).unflatten(1, (-1, 2, 2))
    for board, corner, eye in ((2, 7, 1), (1, 9, 0), (0, 8, 1)):
        sighting = (one.still.left, one.still.right)[eye]
        normals, means = [], []
        for edge, step in enumerate((1, columns)):
            along = sighting.position[board, corner + step] - sighting.position[board, corner - step]
            normals.append(torch.stack([along[1], -along[0]]))
            mean = torch.zeros(2, dtype=torch.float64)
            for node, weight in zip(nodes, weights, strict=True):
                line = lines.lines[board, corner, eye] + node * share * lines.spacing_mm * lines.reach[board, edge]
                place = (line - lines.travel.start_mm[board]) / lines.travel.extent_mm
                whole = lines.directions[board, corner, eye].sum(0)
                mean += (
                    0.5 * weight * sighting.factor[board, corner] @ whole @ (at[board] @ FINE.weights(place[None])[0])
                )
            means.append(mean)
        met = torch.linalg.solve(torch.stack(normals), (torch.stack(normals) * torch.stack(means)).sum(-1))
        found = sighting.factor[board, corner] @ rows[board, corner, eye]
        torch.testing.assert_close(found, met, rtol=2e-3, atol=1e-3 * float(met.abs().max()))
