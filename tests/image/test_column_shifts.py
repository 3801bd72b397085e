"""Columns shifted by constant lines: the plain formula, and rounding."""

import pytest
import torch

from lsvision.image.column_shifts import ColumnShifts

SHIFTS = torch.cat([torch.linspace(-3.0, 4.6, 700, dtype=torch.float64), torch.full((40,), 1.25, dtype=torch.float64)])


def plain(values: torch.Tensor, first: int, rows: int) -> torch.Tensor:
    """Each sample by itself."""
    at = first + torch.arange(rows)[:, None] + SHIFTS
    base, column = at.floor().long(), torch.arange(len(SHIFTS))
    low, high = (values[base + later, column].double() for later in (0, 1))
    return torch.lerp(low, high, at - base)


@pytest.mark.parametrize("rows", [1, 7, 600])
def test_values_between_lines(rows):
    values = torch.randn(rows + 12, len(SHIFTS))
    out = torch.empty(rows, len(SHIFTS))
    ColumnShifts.of(SHIFTS).interpolate(values, 4, out)
    assert (out - plain(values, 4, rows)).abs().max() < 1e-5


def test_bytes_are_rounded_and_clamped():
    values = torch.randint(0, 256, (40, len(SHIFTS)), dtype=torch.uint8)
    out = torch.empty(30, len(SHIFTS), dtype=torch.uint8)
    ColumnShifts.of(SHIFTS).interpolate(values, 3, out)
    assert (out - plain(values, 3, 30)).abs().max() < 0.501
    ColumnShifts.of(SHIFTS).interpolate(torch.full((40, len(SHIFTS)), 300.0), 3, out)
    assert bool((out == 255).all())


def test_pieces_cover_every_sample_once():
    shifts = ColumnShifts.of(SHIFTS)
    count = torch.zeros(1100, len(SHIFTS))
    for piece in shifts.pieces(1100):
        count[piece] += 1
        assert len(shifts.whole[piece[1]].unique()) == 1
    assert bool((count == 1).all())
