"""Rows that both images of a pair show: where they end, and what stands for the others."""

import torch

from lsvision.image.resampled import ResampledImage
from lsvision.image.sheared_rows import ShearedRows
from lsvision.image.stereo.seen_rows import SeenRows
from lsvision.types import TensorImage, Travel

LINES, WIDTH = 60, 9


def image(late_lines: torch.Tensor) -> ResampledImage:
    """An image whose row r shows line r - 10 + ``late_lines``."""
    source = TensorImage(torch.zeros(LINES, WIDTH, 1, dtype=torch.uint8))
    return ResampledImage(source, slice(None), ShearedRows(Travel(0.5), LINES + 20, -10, 0.5 * late_lines))


LEFT = image(torch.linspace(-8.0, 8.0, WIDTH, dtype=torch.float64))
RIGHT = image(torch.linspace(-5.0, 11.0, WIDTH, dtype=torch.float64))


def test_rows_end_where_either_image_does():
    seen = SeenRows.of(LEFT, RIGHT, range(5, 80), 0)
    assert seen is not None
    # Line 0 of the left image lies on rows 18, 16, .. 2, the last one of the right image on rows 74, 72, .. 58.
    assert (seen.first - 2 + 5).tolist() == [18 - 2 * column for column in range(WIDTH)]
    assert (seen.stop + 2 + 5 - 1).tolist() == [74 - 2 * column for column in range(WIDTH)]
    assert SeenRows.of(LEFT, RIGHT, range(20, 50), 0) is None
    later = SeenRows.of(LEFT, RIGHT, range(5, 80), 3)
    assert later is not None
    assert torch.equal(later.stop, seen.stop - 3)


def test_images_that_are_not_resampled_show_all_rows():
    plain = TensorImage(torch.zeros(LINES, WIDTH, 1, dtype=torch.uint8))
    assert SeenRows.of(plain, plain, range(5, 80), 0) is None


def test_values_beyond_are_those_of_the_nearest_row():
    seen = SeenRows(torch.tensor([0, 2, 4]), torch.tensor([6, 5, 6]))
    values = torch.arange(6.0)[:, None] + torch.tensor([0.0, 10.0, 20.0])
    expected = torch.tensor([[0, 1, 2, 3, 4, 5], [12, 12, 12, 13, 14, 14], [24, 24, 24, 24, 24, 25]]).mT
    assert torch.equal(seen.extended(values, 1), expected.float())
    beyond = seen.beyond(values, 1, 0)
    assert beyond.mT.tolist() == [
        [False] * 6, [True, True, False, False, False, True], [True] * 4 + [False] * 2
    ]  # fmt: skip
    # Of blocks of two pixels a side, the last of which reaches beyond the image.
    assert torch.equal(seen.extended(values[:3, :2], 2), values[[[0, 2], [1, 2], [2, 2]], [0, 1]])


def test_no_block_is_left_of_columns_that_neither_image_shows():
    seen = SeenRows(torch.tensor([7, 0]), torch.tensor([8, 1]))
    values = torch.arange(8.0).view(4, 2)
    assert torch.equal(seen.extended(values, 2), torch.tensor([[6.0, 1.0]]).expand(4, 2))
