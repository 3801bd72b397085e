"""What was matched on sheared rows, at places between them: the plain formula, for even and for uneven travel."""

import pytest
import torch

from lsvision.image.sheared_rows import ShearedRows
from lsvision.stages.disparity.ideal_lines import IdealLines
from lsvision.stages.disparity.match import StripMatch
from lsvision.types import Travel

LINES, WIDTH, PITCH = 40, 200, 0.5
LATE_MM = torch.linspace(-3.0, 4.0, WIDTH, dtype=torch.float64)
PLACES = torch.linspace(2.3, WIDTH - 4.7, 180, dtype=torch.float64)
EVEN = Travel(PITCH)
LOGGED = Travel(PITCH, torch.arange(LINES).double() * PITCH)


def match_of(rows: int) -> StripMatch:
    generator = torch.Generator().manual_seed(1)
    disparity, sigma = (torch.randn(rows, WIDTH, generator=generator) for _ in range(2))
    disparity[5:8, 60:90] = torch.nan
    return StripMatch(disparity, sigma)


@pytest.mark.parametrize("travel", [EVEN, LOGGED])
@pytest.mark.parametrize("late", [LATE_MM, None])
def test_samples_around_places(travel, late):
    first = 0 if late is None else -12
    rows = ShearedRows(travel, LINES + 24, first, late)
    match, lines, columns = match_of(LINES + 24), range(10, 30), slice(20, 150)
    found = IdealLines(PLACES, WIDTH, rows).sampled(match, 3, lines, columns)
    u = PLACES[columns]
    v = rows.rows_of(torch.arange(10, 30).double(), u.round().long()) - 3
    u, v = torch.broadcast_tensors(u, v)
    left, above = u.floor().long(), v.floor().long()
    corner = [[match.disparity[above + down, left + right].double() for right in (0, 1)] for down in (0, 1)]
    upper, lower = (torch.lerp(*pair, u - left) for pair in corner)
    between = torch.lerp(upper, lower, v - above) if late is not None else upper
    torch.testing.assert_close(found.between.double(), between, rtol=0, atol=1e-5, equal_nan=True)
    near = (v + 0.5).floor().long(), (u + 0.5).floor().long()
    assert torch.equal(found.nearest.nan_to_num(9.0), match.disparity[near].nan_to_num(9.0))
    assert torch.equal(found.sigma, match.sigma[near])


@pytest.mark.parametrize("travel", [EVEN, LOGGED])
def test_any_range_gives_the_same_bits(travel):
    lines, match = IdealLines(PLACES, WIDTH, ShearedRows(travel, LINES + 24, -12, LATE_MM)), match_of(LINES + 24)
    whole = lines.sampled(match, 0, range(5, 35), slice(0, 180))
    part = lines.sampled(StripMatch(match.disparity[4:], match.sigma[4:]), 4, range(11, 19), slice(33, 120))
    torch.testing.assert_close(part.between, whole.between[6:14, 33:120], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(part.nearest, whole.nearest[6:14, 33:120], rtol=0, atol=0, equal_nan=True)
    assert torch.equal(part.sigma, whole.sigma[6:14, 33:120])
