"""Visible segments and gap filling against loops over every sample and cell."""

import itertools
import math

import pytest
import torch

from lsvision.image.visibility import both_ends, bridge_gaps, interpolate_segments, visible_segments

CELLS = 12


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


@pytest.mark.parametrize("kind", ["monotone", "folded", "stepped", "holed", "stretched"])
def test_equals_the_naive_search(kind):
    position, depth, connected = random_lines(kind)
    segment, fraction = visible_segments(position, depth, connected, CELLS)
    expected, part = naive(position, depth, connected, CELLS)
    assert torch.equal(segment, expected)
    torch.testing.assert_close(fraction, part, rtol=0, atol=1e-12, equal_nan=True)
    assert (segment >= 0).any()


def test_batch_equals_loop():
    position, depth, connected = random_lines("folded")
    segment, fraction = visible_segments(position, depth, connected, CELLS)
    for i in range(len(position)):
        alone = visible_segments(position[i : i + 1], depth[i : i + 1], connected[i : i + 1], CELLS)
        assert torch.equal(alone[0][0], segment[i])
        assert torch.equal(alone[1][0].nan_to_num(nan=-1.0), fraction[i].nan_to_num(nan=-1.0))


def test_step_by_hand():
    # A far surface over cells 0..4 and a nearer one from 2.5 on: the nearer wins where both are.
    position = torch.tensor([[-0.5, 1.5, 3.5, 4.5, 2.5, 4.75, 7.0]]).double()
    depth = torch.tensor([[9.0, 9.0, 9.0, 9.0, 5.0, 5.0, 5.0]]).double()
    connected = torch.tensor([[True, True, True, False, True, True]])
    segment, fraction = visible_segments(position, depth, connected, 8)
    assert segment.tolist() == [[0, 0, 1, 4, 4, 5, 5, -1]]
    expected = torch.tensor([[0.25, 0.75, 0.25, 2 / 9, 2 / 3, 1 / 9, 5 / 9, torch.nan]], dtype=torch.float64)
    torch.testing.assert_close(fraction, expected, rtol=0, atol=1e-12, equal_nan=True)


def test_a_disconnected_step_is_not_filled():
    position = torch.tensor([[0.0, 1.0, 6.0, 7.0]]).double()
    connected = torch.tensor([[True, False, True]])
    segment, _ = visible_segments(position, torch.zeros(1, 4).double(), connected, 8)
    assert segment.tolist() == [[0, -1, -1, -1, -1, -1, 2, -1]]


def test_nothing_to_see():
    for position in (torch.full((2, 4), torch.nan), torch.tensor([[3.0, 2.0, 1.0, 0.0]] * 2), torch.rand(2, 4) - 9):
        segment, fraction = visible_segments(position, position, torch.ones(2, 3, dtype=torch.bool), 5)
        assert (segment == -1).all()
        assert fraction.isnan().all()


def test_interpolation_and_flags_of_segments():
    values = torch.tensor([[1.0, 3.0, torch.nan, 8.0]]).double()
    segment = torch.tensor([[0, 1, 2, -1, 0]])
    fraction = torch.tensor([[0.25, 0.5, 0.5, torch.nan, 1.0]]).double()
    blended = interpolate_segments(values, segment, fraction)
    assert blended.isnan().tolist() == [[False, True, True, True, False]]
    assert blended[0, [0, 4]].tolist() == [1.5, 3.0]
    assert both_ends(values.isfinite(), segment).tolist() == [[True, False, False, False, True]]


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
