"""Marks that repeat, among candidates that do not."""

import pytest
import torch

from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.marks import grouped
from tests.stages.surface.candidates import candidate

CONFIG = SurfaceConfig()


def others(count, seed, length_mm=3000.0):
    generator = torch.Generator().manual_seed(seed)
    along = length_mm * torch.rand(count, generator=generator)
    around = 40 * torch.rand(count, generator=generator) - 20
    return [candidate(float(y), float(s)) for y, s in zip(along, around, strict=True)]


@pytest.mark.parametrize("period_mm", [150.0, 312.4])
@pytest.mark.parametrize("seed", range(3))
def test_a_roll_s_period_is_found(period_mm, seed):
    turns = [turn for turn in range(int(3000 / period_mm)) if turn not in (2,)]
    noise = 0.1 * torch.randn(len(turns), generator=torch.Generator().manual_seed(seed))
    marks = [candidate(30 + period_mm * turn + float(off), 9.0) for turn, off in zip(turns, noise, strict=True)]
    marked = grouped([*others(25, seed), *marks], CONFIG)
    (group,) = marked.groups
    assert group.marks == len(marks)
    assert group.turns == turns[-1] + 1
    assert group.period_mm == pytest.approx(period_mm, rel=0.005)
    assert abs(group.period_mm - period_mm) < 4 * group.period_sigma_mm
    assert [one.group for one in marked.candidates[25:]] == [1] * len(marks)


def test_two_rolls_are_two_groups():
    first = [candidate(150.0 * turn, 9.0) for turn in range(12)]
    second = [candidate(20 + 201.3 * turn, -8.0) for turn in range(9)]
    groups = grouped([*first, *second, *others(20, 5)], CONFIG).groups
    assert [group.marks for group in groups] == [12, 9]
    assert [round(group.period_mm, 3) for group in groups] == [150.0, 201.3]


@pytest.mark.parametrize("seed", range(20))
def test_places_at_random_do_not_repeat(seed):
    assert grouped(others(60, 100 + seed), CONFIG).groups == []


def test_marks_of_colour_alone_and_few_candidates_are_left():
    few = [candidate(150.0 * turn, 9.0) for turn in range(3)]
    colored = [candidate(150.0 * turn, 9.0, kind="color") for turn in range(10)]
    assert grouped([*few, *colored], CONFIG).groups == []
    assert grouped([], CONFIG).groups == []
