"""δx of drawn sheets from their straight sides: errors, what is left out, and what is said where nothing shows it."""

import dataclasses

import pytest
import torch
from torch import Tensor

from lsvision.geometry import slope_at
from lsvision.stages.line_motion import flat, measure
from lsvision.stages.line_motion.edges import measured as edges
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.estimate import not_measured
from lsvision.stages.line_motion.profiles import Reference
from lsvision.types import Motion, TensorImage
from tests.stages.line_motion.edges.drawn import (
    CONFIG,
    FRAME,
    LINE,
    LINES,
    RIG,
    N,
    Stripe,
    Z,
    along,
    errors_of,
    measured,
    scan_of,
    shaken,
    sheet,
)

STANDING = 0 * LINE


@pytest.fixture(autouse=True)
def _cameras_in_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edges, "relation_of_scan", lambda *_: None)


def rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("per_line_mm", [0.0, 0.015], ids=["along", "slanted"])
def test_two_sides_show_it_as_well_as_their_sigma_says(per_line_mm: float) -> None:
    dx = shaken()
    found = measured([sheet(dx, per_line_mm=per_line_mm)])
    assert (found.findings[0].state, found.findings[0].edges) == ("corrected", 2)
    assert found.findings[0].sigma == pytest.approx(0.006, abs=0.001)
    assert "from 2 straight edges along the travel and the trend of its " in found.findings[0].in_words
    assert rms(errors_of(found, dx) * found.sigma[:, 0]) < 0.01
    assert 0.6 < rms(errors_of(found, dx)) < 1.25


def test_a_still_sheet_stays_to_the_bit() -> None:
    found = measured([sheet(shaken(0.0))])
    assert found.is_still
    assert [finding.state for finding in found.findings] == ["absent"] * 3
    assert "from 2 straight edges along the travel" in found.findings[0].in_words


@pytest.mark.parametrize(
    ("stripes", "words"),
    [
        ([sheet(shaken(), right=900.0)], "fewer than two straight edges along the travel show it, and the object's"),
        ([sheet(shaken(), -500.0, 900.0)], "fewer than two straight edges along the travel show it"),
        (
            [Stripe(along(0.0, shaken()), along(300.0, shaken() + ((LINE - 200) / 200) ** 2), 130.0)],
            "two edges along the travel contradict each other by 0.17 mm",
        ),
        (  # a shadow that stands still
            [sheet(shaken()), Stripe(STANDING + 140, STANDING + 160, 220.0)],
            "its edges along the travel contradict each other, and the object's shape does not show it",
        ),
        (  # a rail of the machine over the sheet, which parts it
            [sheet(shaken()), Stripe(STANDING + 140, STANDING + 160, 220.0, Z - 10)],
            "fewer than two straight edges along the travel show it",
        ),
    ],
    ids=["one side", "no side", "a curved side", "a shadow", "a rail over it"],
)
def test_what_does_not_show_it_is_said(stripes: list[Stripe], words: str) -> None:
    found = measured(stripes)
    assert found.findings[0].state == "not observed"
    assert words in found.findings[0].in_words
    assert not found.dx_mm.any()


@pytest.mark.parametrize(
    ("beside", "count"),
    [
        (Stripe(STANDING + 340, STANDING + 360, 200.0, Z - 10), 2),  # a rail of the machine over the conveyor
        (Stripe(along(100.0, shaken(), 0.4), along(110.0, shaken(), 0.4), 30.0), 2),  # a line that runs askew
        (Stripe(along(20.0, shaken()), along(30.0, shaken() + ((LINE - 200) / 200) ** 2), 30.0), 3),
    ],
    ids=["a guard rail", "a diagonal line", "a curved line"],
)
def test_edges_of_something_else_are_left_out(beside: Stripe, count: int) -> None:
    found = measured([sheet(shaken()), beside])
    assert (found.findings[0].state, found.findings[0].edges) == ("corrected", count)
    assert rms(errors_of(found, shaken()) * found.sigma[:, 0]) < 0.01


def test_it_can_be_switched_off() -> None:
    found = measured([sheet(shaken())], config=dataclasses.replace(CONFIG, straight_edges=False))
    assert found.findings[0].state == "not observed"
    assert "edges" not in found.findings[0].in_words


def test_edges_are_not_looked_for_where_the_profile_shows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_of_it(*_: object) -> None:
        raise AssertionError("edges of an object whose profile shows δx")

    monkeypatch.setattr(flat, "measure_edges", none_of_it)
    scan, depth = scan_of([sheet(shaken(0.0))])
    x = slope_at(RIG, torch.arange(RIG.width_px).double()) * Z
    round_ = Z + ((x - 150.0) / 8.0).square() / 8
    noise = torch.randn(LINES, RIG.width_px, generator=torch.Generator().manual_seed(0))
    depth = dataclasses.replace(depth, z=TensorImage((round_ + 0.02 * noise).float()[..., None]))
    found = measure.measure_line_motion(scan, depth, Motion(N, torch.zeros(3, 3).double()), CONFIG).motion
    assert found.findings[0].state != "not observed"


def test_too_many_or_too_few_lines_are_said() -> None:
    scan, _ = scan_of([sheet(shaken(0.0))])
    flat_object = FlatObject(FRAME, 0.0, 0.0, 0.0, 300.0, Reference(0.0, 1.0, STANDING, STANDING), True)
    for lines, words in ((40_000, "no more than 32768 lines"), (10, "fewer than two straight edges")):
        still, level = not_measured(lines, ""), torch.zeros(lines, 3).double()
        said = edges.measure_edges(scan, flat_object, still, level, torch.ones(lines, dtype=torch.bool), CONFIG)
        assert isinstance(said, str)
        assert words in said
