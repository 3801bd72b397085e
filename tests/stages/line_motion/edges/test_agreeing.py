"""Which tracks agree, and straight lines through what is off on some lines."""

import torch

from lsvision.stages.line_motion.edges.agreeing import largest_group
from lsvision.stages.line_motion.edges.edge_lines import EdgeLines, robust_straight

LINE = torch.arange(300).double()
WAVE = torch.sin(LINE / 20)
EVERY = (LINE >= 20).expand(5, -1)
LINES = EdgeLines(torch.zeros(300, 4).double(), LINE / 150 - 1, LINE >= 20, 0.3)


def test_tracks_of_one_object_agree_whatever_their_slant() -> None:
    noise = 0.05 * torch.randn(5, 300, generator=torch.Generator().manual_seed(0)).double()
    place = torch.stack([WAVE, 100 + WAVE - 0.02 * LINE, 50 + 0 * LINE, 70 + 3 * WAVE, 90 + WAVE]) + noise
    place[1, 100:130] += 20.0  # on other lines it follows something else
    group = largest_group(place, EVERY[: len(place)], LINES, 0.2)
    assert group.members.tolist() == [0, 1, 4]
    assert group.rivals == 0


def test_a_group_as_large_is_a_rival() -> None:
    group = largest_group(torch.stack([WAVE, 100 + WAVE, 40 + 0 * LINE, 60 + 0 * LINE]), EVERY[:4], LINES, 0.2)
    assert (len(group.members), group.rivals) == (2, 2)


def test_single_tracks_are_no_group() -> None:
    assert not len(largest_group(torch.stack([WAVE, 3 * WAVE]), EVERY[:2], LINES, 0.2).members)
    assert not len(largest_group(torch.zeros(0, 300).double(), EVERY[:0], LINES, 0.2).members)


def test_a_line_is_that_of_most_places() -> None:
    place = torch.stack([3.0 + 0.5 * LINES.along, -1.0 - 2.0 * LINES.along])
    place[:, 150:230] += 5.0
    place[:, :20] = torch.nan_to_num(torch.tensor(torch.nan), nan=1e6)  # lines that are not used
    expected = torch.tensor([[3.0, 0.5], [-1.0, -2.0]]).double()
    torch.testing.assert_close(robust_straight(place, LINES, torch.ones_like(place)), expected, rtol=0, atol=0.02)


def test_lines_and_means_are_those_of_least_squares() -> None:
    generator = torch.Generator().manual_seed(0)
    values, weight = torch.randn(2, 300, generator=generator).double(), torch.rand(2, 300, generator=generator).double()
    root = (weight * LINES.used).sqrt()
    expected = torch.linalg.lstsq(root[..., None] * LINES.design, (root * values)[..., None]).solution[..., 0]
    torch.testing.assert_close(LINES.straight(values, weight), expected)
    kernel = torch.exp(-0.5 * ((LINE[:, None] - LINE) / 5).square()) * ((LINE[:, None] - LINE).abs() <= 15)
    heavy = weight * LINES.used
    expected = ((heavy * values) @ kernel / (heavy @ kernel)).nan_to_num()
    torch.testing.assert_close(LINES.smooth(values, weight, 1.5), expected)
