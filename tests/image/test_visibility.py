"""Visible segments and gap filling against loops over every sample and cell."""

import itertools
import math

import pytest
import torch

from lsvision.image.visibility import Seen, Surface, bridge_gaps, see_cells

CELLS = 12


HALF_PART = 0.5 / 2048 + 1e-9


def see(position, depth, connected, cells, *, carried=(), measured=None, dim=1) -> Seen:
    """What cells see of lines given along the last axis, whichever axis they are handed over along."""
    samples = position.shape[1]
    whole = torch.arange(samples).to(position.dtype) - 3  # any whole numbers will do

    def laid(values):
        return values.mT.contiguous() if dim == 0 else values

    measured = connected if measured is None else measured
    surface = Surface(
        whole, laid(position - whole), laid(-depth), [laid(each) for each in carried], laid(connected), laid(measured)
    )
    seen = see_cells(surface, cells, dim)
    return Seen.of([values.mT if dim == 0 else values for values in seen.tensors()])


def naive(position, depth, connected, cells):
    """For every cell the nearest of all segments that cover it; of equals the last."""
    segment = torch.full((len(position), cells), -1)
    fraction = torch.full((len(position), cells), torch.nan, dtype=position.dtype)
    for line in range(len(position)):
        for cell in range(cells):
            nearest = math.inf
            for i in range(position.shape[1] - 1):
                low, high = float(position[line, i]), float(position[line, i + 1])
                if not (bool(connected[line, i]) and low <= cell < high):
                    continue
                part = (cell - low) / (high - low)
                seen = float(depth[line, i]) * (1 - part) + float(depth[line, i + 1]) * part
                if seen <= nearest + 1e-12:
                    nearest, segment[line, cell], fraction[line, cell] = seen, i, part
    return segment, fraction


def random_lines(kind: str):
    lines, samples = 15, 30
    position = torch.cumsum(0.5 * torch.rand(lines, samples).double(), 1) - 1.0
    depth = torch.rand(lines, samples).double()
    connected = torch.ones(lines, samples - 1, dtype=torch.bool)
    if kind == "folded":
        position = position + 1.5 * torch.sin(torch.arange(samples).double())
    if kind == "stepped":
        position[:, 11:] -= 3.0
        depth[:, 11:] -= 5.0
        connected[:, 10] = False
    if kind == "holed":
        position[torch.rand(lines, samples) < 0.15] = torch.nan
        connected = torch.isfinite(position.diff(dim=1))
    if kind == "stretched":
        position = position * 4 - 6
    return position, depth, connected


@pytest.mark.parametrize("dim", [0, 1])
@pytest.mark.parametrize("kind", ["monotone", "folded", "stepped", "holed", "stretched"])
def test_equals_the_naive_search(kind, dim):
    position, depth, connected = random_lines(kind)
    other = torch.rand(position.shape).double()
    seen = see(position, depth, connected, CELLS, carried=(other,), dim=dim)
    segment, fraction = naive(position, depth, connected, CELLS)
    exact = {"rtol": 0, "atol": 1e-12, "equal_nan": True}
    begin, end = segment.clamp(min=0), segment.clamp(min=0) + 1
    nothing = torch.where(segment < 0, torch.nan, 0.0).double()
    torch.testing.assert_close(seen.place, segment + fraction + nothing, rtol=0, atol=HALF_PART, equal_nan=True)
    for values, found in ((-depth, seen.height), (other, seen.carried[0])):
        torch.testing.assert_close(found, torch.lerp(values.gather(1, begin), values.gather(1, end), fraction), **exact)
    assert torch.equal(seen.measured, segment >= 0)
    assert (segment >= 0).any()


@pytest.mark.parametrize("dim", [0, 1])
def test_batch_equals_loop(dim):
    position, depth, connected = random_lines("folded")
    seen = see(position, depth, connected, CELLS, dim=dim)
    for i in range(len(position)):
        alone = see(position[i : i + 1], depth[i : i + 1], connected[i : i + 1], CELLS, dim=dim)
        for one, all_of_them in zip(alone.tensors(), seen.tensors(), strict=True):
            assert torch.equal(one[0].nan_to_num(nan=-1.0), all_of_them[i].nan_to_num(nan=-1.0))


def test_whole_cells_come_off_without_rounding():
    position, depth, connected = (values[:, :20] for values in random_lines("folded"))
    connected = connected[:, :19]
    whole, part = position.floor(), (position - position.floor()).float()
    surfaces = [
        Surface(whole[0].float() + shift, part[:1], -depth[:1].float(), (), connected[:1], connected[:1])
        for shift in (0.0, 5000.0)
    ]
    here, there = see_cells(surfaces[0], 12, 1), see_cells(surfaces[1], 5012, 1)
    for near, far in zip(here.tensors(), there.tensors(), strict=True):
        assert torch.equal(near.nan_to_num(nan=-1.0), far[:, 5000:].nan_to_num(nan=-1.0))


def test_a_segment_that_rounding_makes_cover_a_cell_shows_its_end():
    # Twice the same place; in single precision 1 + 1e-9 is 1, and only the second lies before cell 1.
    whole, part = torch.tensor([0.0, 1.0, 2.0]), torch.tensor([[1.0, 1e-9, 0.5]])
    height, connected = torch.tensor([[3.0, 3.0, 4.0]]), torch.ones(1, 2, dtype=torch.bool)
    seen = see_cells(Surface(whole, part, height, (), connected, connected), 3, 1)
    assert seen.place[0, 1:].tolist() == [0.0, pytest.approx(1 + 2 / 3, abs=HALF_PART)]
    assert seen.height[0, 1] == 3.0


def test_step_by_hand():
    # A far surface over cells 0..4 and a nearer one from 2.5 on: the nearer wins where both are.
    position = torch.tensor([[-0.5, 1.5, 3.5, 4.5, 2.5, 4.75, 7.0]]).double()
    depth = torch.tensor([[9.0, 9.0, 9.0, 9.0, 5.0, 5.0, 5.0]]).double()
    connected = torch.tensor([[True, True, True, False, True, True]])
    measured = torch.tensor([[True, False, True, True, True, True]])
    seen = see(position, depth, connected, 8, measured=measured)
    expected = torch.tensor([[0.25, 0.75, 1.25, 4 + 2 / 9, 4 + 2 / 3, 5 + 1 / 9, 5 + 5 / 9, torch.nan]])
    torch.testing.assert_close(seen.place, expected.double(), rtol=0, atol=HALF_PART, equal_nan=True)
    assert seen.height[0, :7].tolist() == [-9.0, -9.0, -9.0, -5.0, -5.0, -5.0, -5.0]
    assert seen.measured.tolist() == [[True, True, False, True, True, True, True, False]]


def test_a_disconnected_step_is_not_filled():
    position = torch.tensor([[0.0, 1.0, 6.0, 7.0]]).double()
    connected = torch.tensor([[True, False, True]])
    seen = see(position, torch.zeros(1, 4).double(), connected, 8)
    assert seen.place.isfinite().tolist() == [[True, False, False, False, False, False, True, False]]


def test_nothing_to_see():
    for position in (torch.full((2, 4), torch.nan), torch.tensor([[3.0, 2.0, 1.0, 0.0]] * 2), torch.rand(2, 4) - 9):
        seen = see(position, position, torch.ones(2, 3, dtype=torch.bool), 5)
        assert seen.place.isnan().all()
        assert seen.height.isnan().all()
        assert not seen.measured.any()


@pytest.mark.parametrize("dim", [0, 1])
def test_a_segment_over_many_cells_is_cut_to_them(dim):
    position = torch.tensor([[-4.0, 20.0]]).double()
    connected = torch.ones(1, 1, dtype=torch.bool)
    seen = see(position, torch.tensor([[0.0, 24.0]]).double(), connected, 8, dim=dim)
    assert torch.equal(seen.height, -torch.arange(4.0, 12.0).double()[None])


def naive_bridge(values, longest, largest_step):
    filled = values.clone()
    for line in range(len(values)):
        known = [i for i in range(values.shape[1]) if math.isfinite(values[line, i])]
        for a, b in itertools.pairwise(known):
            begin, end = float(values[line, a]), float(values[line, b])
            if 1 < b - a <= longest + 1 and abs(end - begin) <= largest_step * (b - a):
                for i in range(a + 1, b):
                    filled[line, i] = begin + (end - begin) * (i - a) / (b - a)
    return filled


def test_bridging_equals_the_naive_loop():
    values = torch.cumsum(torch.rand(20, 60).double() - 0.5, 1)
    values[torch.rand(20, 60) < 0.6] = torch.nan
    filled = bridge_gaps(values, longest=3, largest_step=0.3)
    torch.testing.assert_close(filled, naive_bridge(values, 3, 0.3), rtol=0, atol=1e-12, equal_nan=True)
    assert filled.isnan().any()
    assert (filled.isfinite() & values.isnan()).any()


def test_bridging_by_hand():
    nan = torch.nan
    line = torch.tensor([[nan, 1.0, nan, nan, 4.0, nan, 9.0, nan, nan, nan, 9.0, nan]]).double()
    filled = bridge_gaps(line, longest=2, largest_step=1.0)
    expected = torch.tensor([[nan, 1.0, 2.0, 3.0, 4.0, nan, 9.0, nan, nan, nan, 9.0, nan]]).double()
    torch.testing.assert_close(filled, expected, equal_nan=True)
    assert bridge_gaps(torch.full((1, 3), nan), longest=9, largest_step=1.0).isnan().all()
