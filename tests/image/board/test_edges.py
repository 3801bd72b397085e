"""Edges of squares on every line: where they are, how well that is known, and what is left out."""

import math

import pytest
import torch

from lsvision.image.board.edges import Crossings, EdgeSegments, common_lines, find_crossings
from lsvision.types import TensorImage

WIDTH, LINES = 120, 90


def picture(column: torch.Tensor, blur: float, *, noise: float = 0.0, dark: float = 40.0, bright: float = 200.0):
    """Lines that turn from dark to bright at a column each, seen through box pixels and blur."""
    u = torch.arange(WIDTH, dtype=torch.float64)
    fine = (u[:, None] + (torch.arange(51, dtype=torch.float64) - 25) / 51).flatten()
    step = 0.5 * (1 + torch.erf((fine - column[:, None]) / (math.sqrt(2) * blur)))
    lines = dark + (bright - dark) * step.unflatten(-1, (WIDTH, 51)).mean(-1)
    return lines + noise * torch.randn(lines.shape, dtype=torch.float64)


def segments(first: float, last: float) -> EdgeSegments:
    """One segment over the whole picture."""
    return EdgeSegments(
        torch.tensor([[first, 0.0]], dtype=torch.float64),
        torch.tensor([[last, LINES - 1.0]], dtype=torch.float64),
        60.0,
    )


def located(lines: torch.Tensor, edge: EdgeSegments) -> tuple[Crossings, torch.Tensor]:
    image = TensorImage(lines[..., None].to(torch.float32))
    segment, line = common_lines(edge)
    return find_crossings(image, edge, segment, line), line


@pytest.mark.parametrize("blur", [0.3, 0.6, 1.2, 2.5])
@pytest.mark.parametrize("polarity", [1, -1])
def test_edges_lie_where_they_are_drawn(blur: float, polarity: int) -> None:
    column = 52.0 + 0.113 * torch.arange(LINES, dtype=torch.float64)
    levels = {"dark": 40.0, "bright": 200.0} if polarity > 0 else {"dark": 200.0, "bright": 40.0}
    found, line = located(picture(column, blur, **levels), segments(52.0, float(column[-1])))
    assert bool(found.valid.all())
    assert len(line) == math.floor(0.8 * 89) - math.ceil(0.2 * 89) + 1
    assert bool((found.step.sign() == polarity).all())
    torch.testing.assert_close(found.column, column[line], atol=4e-3, rtol=0)


def test_a_bent_edge_is_followed() -> None:
    v = torch.arange(LINES, dtype=torch.float64)
    column = 60.0 + 4.0 * torch.sin(v / 20.0)
    found, line = located(picture(column, 0.7), segments(60.0, 60.0))
    assert bool(found.valid.all())
    torch.testing.assert_close(found.column, column[line], atol=4e-3, rtol=0)


def test_errors_are_as_large_as_their_sigma() -> None:
    torch.manual_seed(0)
    errors, sigmas = [], []
    for trial in range(8):
        column = 50.0 + 0.07 * trial + 0.05 * torch.arange(LINES, dtype=torch.float64)
        found, line = located(picture(column, 0.7, noise=2.0), segments(50.0, 54.0))
        errors.append(found.column - column[line])
        sigmas.append(found.variance.sqrt())
    ratio = torch.cat(errors) / torch.cat(sigmas)
    assert float(ratio.square().mean().sqrt()) == pytest.approx(1.0, abs=0.12)
    assert abs(float(ratio.mean())) < 0.2


def test_crossings_do_not_depend_on_each_other_nor_on_bands() -> None:
    torch.manual_seed(1)
    column = 45.0 + 0.2 * torch.arange(600, dtype=torch.float64) / 6
    lines = picture(column, 0.7, noise=1.0)
    edge = EdgeSegments(torch.tensor([[45.0, 0.0]]).double(), torch.tensor([[65.0, 599.0]]).double(), 60.0)
    together, line = located(lines, edge)
    # Of one polarity and one blur: a crossing alone gives the same but for what all decide together.
    shifted, _ = located(torch.cat([lines[:0], lines]), edge)
    assert torch.equal(together.column, shifted.column)
    torch.testing.assert_close(together.column, column[line], atol=0.08, rtol=0)


def test_flat_and_unseen_segments_cross_no_line() -> None:
    nan = float("nan")
    edge = EdgeSegments(
        torch.tensor([[10.0, 10.0], [10.0, nan], [20.0, 5.0]]).double(),
        torch.tensor([[90.0, 30.0], [10.0, 60.0], [20.0, 45.0]]).double(),
        60.0,
    )
    segment, line = common_lines(edge)
    assert set(segment.tolist()) == {2}
    assert (int(line[0]), int(line[-1])) == (13, 37)
    later = EdgeSegments(edge.start, edge.stop + torch.tensor([0.0, 20.0]).double(), 60.0)
    _, both = common_lines(edge, later)
    assert (int(both[0]), int(both[-1])) == (17, 37)


def test_where_there_is_no_edge_nothing_is_measured() -> None:
    torch.manual_seed(2)
    column = torch.full((LINES,), 60.0, dtype=torch.float64)
    lines = picture(column, 0.7, noise=1.0)
    lines[40:50] = 120.0 + torch.randn(10, WIDTH, dtype=torch.float64)
    found, line = located(lines, segments(60.0, 60.0))
    hidden = (line >= 40) & (line < 50)
    assert not bool(found.valid[hidden].any())
    assert bool(found.valid[~hidden].all())


def test_edges_at_the_rim_of_the_image_are_left_out() -> None:
    column = torch.full((LINES,), 3.0, dtype=torch.float64)
    found, _ = located(picture(column, 0.7), segments(3.0, 3.0))
    assert not bool(found.valid.any())
