"""Which blocks unusable samples spoil, counted by hand and by a loop over the samples that each block reads."""

import math

import pytest
import torch

from lsvision.image.stereo.clipping import UnusableSamples, holes_factor

LINES, WIDTH = 7, 21


def marked(*samples: tuple[int, int]) -> torch.Tensor:
    unusable = torch.zeros(LINES, WIDTH, dtype=torch.bool)
    for line, column in samples:
        unusable[line, column] = True
    return unusable


def spoilt_columns(unusable: UnusableSamples, disparity: torch.Tensor, row: int, block: int) -> list[int]:
    return unusable.removed_from(disparity, block)[row].isnan().nonzero()[:, 0].tolist()


def test_a_sample_of_the_left_image_spoils_itself_and_the_slopes_beside_it():
    unusable = UnusableSamples(marked((3, 10)), None)
    assert spoilt_columns(unusable, torch.zeros(LINES, WIDTH), 3, 1) == [9, 10, 11]
    assert spoilt_columns(unusable, torch.zeros(LINES, WIDTH), 2, 1) == []


def test_a_sample_of_the_right_image_spoils_what_is_interpolated_from_it():
    unusable = UnusableSamples(None, marked((3, 10)))
    disparity = torch.full((LINES, WIDTH), 4.0)
    assert spoilt_columns(unusable, disparity, 3, 1) == [12, 13, 14, 15, 16]
    assert torch.equal(disparity, torch.full((LINES, WIDTH), 4.0))  # the argument stays


def reads(row: int, column: int, disparity: float, block: int) -> tuple[set, set]:
    """Samples (line, column) of both images that least squares at a block read."""
    left, right = set(), set()
    for line in range(block * row, block * row + block):
        for u in range(block * column, block * column + block):
            left |= {(line, u + step) for step in (-1, 0, 1)}
            base = math.floor(u - disparity)
            right |= {(line, base + step) for step in (0, 1)}  # the two that weigh most
    return left, right


@pytest.mark.parametrize("block", [1, 2])
def test_no_block_that_is_left_reads_an_unusable_sample(block):
    generator = torch.Generator().manual_seed(2)
    left, right = (torch.rand(LINES, WIDTH, generator=generator) < 0.04 for _ in range(2))
    shape = -(-LINES // block), -(-WIDTH // block)
    disparity = 5 * torch.rand(shape, generator=generator) - 2
    kept = UnusableSamples(left, right).removed_from(disparity, block)
    spoilt = [set(map(tuple, image.nonzero().tolist())) for image in (left, right)]
    for row, column in kept.isfinite().nonzero().tolist():
        for read, bad in zip(reads(row, column, float(disparity[row, column]), block), spoilt, strict=True):
            assert not read & bad
    assert 0.2 < kept.isfinite().float().mean() < 0.95
    assert torch.equal(kept[kept.isfinite()], disparity[kept.isfinite()])


def test_nothing_changes_where_every_sample_is_usable():
    disparity = torch.rand(LINES, WIDTH)
    assert UnusableSamples(None, None).removed_from(disparity, 1) is disparity


def test_variance_grows_with_what_a_window_has_lost():
    searched = torch.zeros(20, 20)
    searched[0, 0] = torch.nan  # never had a match
    kept = searched.clone()
    kept[8:13, 8:10] = torch.nan
    factor = holes_factor(searched, kept, 5)
    assert factor[10, 8] == pytest.approx((1 - 10 / 25) ** -2)
    assert factor[10, 11] == pytest.approx((1 - 5 / 25) ** -2)
    assert factor[2, 2] == 1
