"""Tracks of edges, and shifts of their lines, in drawn scans."""

import torch

from lsvision.stages.line_motion.edges.cells import Cells
from lsvision.stages.line_motion.edges.strips import Strips
from lsvision.stages.line_motion.edges.tracks import find_tracks
from tests.stages.line_motion.edges.drawn import FRAME, LINES, RIG, Z, scan_of, shaken, sheet

ALL = torch.ones(2, LINES, dtype=torch.bool)


def sides(noise: float = 3.0) -> tuple[Cells, torch.Tensor]:
    """Cells of a slanted sheet that shakes, and where both its sides lie in the left image."""
    stripe = sheet(shaken(), per_line_mm=0.03)
    cells = Cells.of(scan_of([stripe], noise=noise)[0])
    x = torch.stack([stripe.left, stripe.right])
    return cells, cells.place(FRAME.rig.principal_left_px + x / Z * RIG.focal_length_mm / RIG.pixel_pitch_um * 1e3)


def test_tracks_follow_edges_to_a_cell() -> None:
    cells, place = sides()
    tracks = find_tracks(cells, range(LINES), 0.56)
    off = (tracks.place[:, None] - place).abs().amax(-1).amin(0)
    assert off.max() < 1.5


def test_tracks_of_some_lines_are_those_of_the_scan() -> None:
    cells, place = sides()
    part = range(37, 361)
    off = (find_tracks(cells, part, 0.56).place[:, None] - place[:, 37:361]).abs().amax(-1).amin(0)
    assert off.max() < 1.5


def test_shifts_of_lines_are_found() -> None:
    cells, place = sides(noise=0.0)
    moved = 0.3 * torch.sin(torch.arange(LINES) / 5.0).double()
    strips = Strips.read(cells, (place + 2.0)[None], range(LINES))
    found = strips.shifts((place - moved)[None], ALL)
    error = found.moved / found.contrast - moved
    assert error.abs().max() < 0.08
    assert error.square().mean().sqrt() < 0.03
    assert (found.contrast - 1).abs().max() < 0.2
    one = strips.of(torch.tensor([1])).shifts((place - moved)[None, 1:], ALL[1:])
    torch.testing.assert_close(one.moved, found.moved[:, 1:])


def test_columns_become_cells_about_their_middles() -> None:
    scan, _ = scan_of([sheet(shaken(0.0))])
    cells = Cells(scan, 3)
    torch.testing.assert_close(cells.place(torch.tensor([1.0, 4.0])), torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(cells.column(cells.place(torch.tensor([2.5]))), torch.tensor([2.5]))
    image = scan.left.read(5, 7).float()[..., 0]
    torch.testing.assert_close(cells.read(0, 5, 7)[:, 1], image[:, 3:6].mean(1))
    assert torch.equal(cells.read(0, -2, 1)[0], cells.read(0, 0, 1)[0])
