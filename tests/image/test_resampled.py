"""Images that are resampled where they are read: places, ends, missing lines, and the same bits from any range."""

import dataclasses

import pytest
import torch

from lsvision.geometry import line_at, travel_at
from lsvision.image.resampled import ResampledImage
from lsvision.image.sheared_rows import ShearedRows
from lsvision.types import TensorImage, Travel

LINES, WIDTH = 90, 300
PITCH = 0.5
LATE_MM = torch.linspace(-3.0, 4.0, WIDTH, dtype=torch.float64)


def uneven() -> torch.Tensor:
    return (torch.arange(LINES).double() * PITCH) + 0.1 * torch.sin(torch.arange(LINES).double() / 7)


TRAVELS = {
    "even": Travel(PITCH),
    "reverse": Travel(PITCH, transport="reverse"),
    "log": Travel(PITCH, uneven()),
}


@pytest.mark.parametrize("name", TRAVELS)
def test_columns_of_a_row_lie_late_by_their_travel(name):
    travel = TRAVELS[name]
    rows = ShearedRows(travel, LINES + 20, -10, LATE_MM)
    number = torch.arange(LINES + 20).double()
    at = rows.lines(number)
    exact = line_at(travel, travel_at(travel, number[:, None] - 10) + LATE_MM)
    assert (at - exact).abs().max() < (0.02 if name == "log" else 3e-4)
    inside = slice(20, 70)
    back = rows.rows_of(torch.arange(LINES).double())
    there = torch.stack([rows.lines(back[inside, column], slice(column, column + 1))[:, 0] for column in (0, 150, 299)])
    assert (there - torch.arange(LINES).double()[inside]).abs().max() < (0.02 if name == "log" else 6e-4)
    torch.testing.assert_close(rows.lines(number, slice(120, 180)), at[:, 120:180], rtol=0, atol=0)
    low, high = rows.reach((30, 40))
    assert low <= back[30:40].min()
    assert back[30:40].max() < high - 1


def picture() -> torch.Tensor:
    """A plane of grey values, which any interpolation reproduces."""
    line, column = torch.meshgrid(torch.arange(LINES).float(), torch.arange(WIDTH).float(), indexing="ij")
    return (0.7 * line + 0.4 * column)[..., None].expand(-1, -1, 2).contiguous()


@pytest.mark.parametrize("columns", [torch.linspace(3.3, WIDTH - 8.1, 250, dtype=torch.float64), slice(None)])
@pytest.mark.parametrize("name", TRAVELS)
def test_samples_lie_where_they_are_said_to(name, columns):
    late = LATE_MM if isinstance(columns, slice) else LATE_MM[: len(columns)]
    rows = ShearedRows(TRAVELS[name], LINES + 40, -20, late)
    image = ResampledImage(TensorImage(picture()), columns, rows)
    assert image.shape == (LINES + 40, len(late), 2)
    line = rows.lines(torch.arange(LINES + 40).double())
    column = torch.arange(WIDTH).double() if isinstance(columns, slice) else columns
    inside = (line > 2) & (line < LINES - 3) & (column > 2) & (column < WIDTH - 3)
    error = image.read(0, LINES + 40)[..., 1] - (0.7 * line + 0.4 * column)
    assert error[inside].abs().max() < 1e-3
    outside = image.outside(range(LINES + 40))
    assert torch.equal(outside, (line < 0) | (line > LINES - 1))
    assert image.outside(range(55, 58)) is None


@pytest.mark.parametrize("name", TRAVELS)
def test_any_range_gives_the_same_bits(name):
    source = TensorImage(torch.randint(0, 256, (LINES, WIDTH, 3), dtype=torch.uint8))
    rows = ShearedRows(TRAVELS[name], LINES + 40, -20, LATE_MM)
    columns = torch.linspace(-4.2, WIDTH + 3.7, WIDTH, dtype=torch.float64)
    image = ResampledImage(source, columns, rows)
    whole = image.read(0, LINES + 40)
    for start, stop in ((0, 7), (31, 32), (60, 130)):
        assert torch.equal(image.read(start, stop), whole[start:stop])


def test_even_travel_is_read_by_whole_lines_as_by_single_places():
    source = TensorImage(torch.randint(0, 256, (LINES, WIDTH, 3), dtype=torch.uint8))
    columns = torch.linspace(-4.2, WIDTH + 3.7, WIDTH, dtype=torch.float64)
    logged = Travel(PITCH, torch.arange(LINES).double() * PITCH)
    one, other = (
        ResampledImage(source, columns, ShearedRows(travel, LINES + 40, -20, LATE_MM)).read(0, LINES + 40)
        for travel in (Travel(PITCH), logged)
    )
    difference = (one.int() - other.int()).abs()
    assert difference.max() <= 1
    assert difference.float().mean() < 0.01


def test_marked_samples_spread_to_what_is_interpolated_from_them():
    rows = ShearedRows(Travel(PITCH), LINES + 40, -20, LATE_MM)
    columns = torch.linspace(0.4, WIDTH - 1.6, WIDTH, dtype=torch.float64)
    image = ResampledImage(TensorImage(torch.zeros(LINES, WIDTH, 1, dtype=torch.uint8)), columns, rows)
    wanted = range(30, 90)
    taken = image.source_lines(wanted)
    marked = torch.zeros(len(taken), WIDTH, dtype=torch.bool)
    marked[20, 100] = True
    values = image.resample(marked[..., None].float(), taken.start, wanted)[..., 0]
    spread = image.spread(marked, taken.start, wanted)
    assert spread[values.abs() > 0.1].all()
    assert 4 <= int(spread.sum()) <= 9
    assert not image.spread(torch.zeros_like(marked), taken.start, wanted).any()


def test_rows_beside_missing_lines_are_missing():
    source = TensorImage(torch.zeros(LINES, WIDTH, 1, dtype=torch.uint8))

    @dataclasses.dataclass(frozen=True)
    class Holed(TensorImage):
        missing: tuple[range, ...] = (range(40, 45),)

    rows = ShearedRows(Travel(PITCH), LINES + 40, -20, LATE_MM)
    image = ResampledImage(Holed(source.tensor), slice(None), rows)
    line = rows.lines(torch.arange(LINES + 40).double())
    touched = ((line > 39) & (line < 45)).any(1).nonzero()[:, 0].tolist()
    (missing,) = image.missing
    assert set(touched) <= set(missing)
    assert len(missing) <= len(touched) + 8
