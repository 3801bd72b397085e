"""Matching from coarse to fine: the same answers as one pass, beside edges too, and none where there is none."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from lsvision.image.stereo.blocks import enlarged
from lsvision.image.stereo.coarse_to_fine import match_coarse_to_fine
from lsvision.image.stereo.refine import RefineOptions, refine_disparity
from lsvision.image.stereo.sgbm import GrayPair
from tests.image.stereo.test_sgbm import search


def textured(lines: int = 96, width: int = 360) -> torch.Tensor:
    """Detail of 2 to 8 px: a quarter of the size still shows some of it."""
    total = torch.zeros(lines, width)
    for size in (2, 4, 8):
        noise = torch.rand(1, 1, lines + 2 * size, width + 2 * size)
        for _ in range(2):
            noise = F.avg_pool2d(noise, size, 1, size // 2)
        total += size * noise[0, 0, :lines, :width]
    return (40 + 175 * (total - total.min()) / (total.max() - total.min())).to(torch.uint8)[..., None]


def pair(shift: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Left and right strips of a plane of the given disparity."""
    wide = textured()
    return wide[:, 40:320].contiguous(), wide[:, 40 + shift : 320 + shift].contiguous()


def match(left, right, low=-40, high=40):
    """The search and the refinement that completes it."""
    grey = GrayPair.of(left, right)
    start = match_coarse_to_fine(grey, search(low, high), fine_check_px=4, noise=1.0)
    options = RefineOptions(window=9, iterations=1, noise=1.0, largest_sigma_px=0.5)
    lines, width = grey.left.shape
    return enlarged(refine_disparity(grey.left, grey.right, start, options).disparity, 2)[:lines, :width]


@pytest.fixture
def step() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Left and right view of a surface of disparity 30 from column 300 to 500 of the left image, before one of 2."""
    ground, front = textured(128, 900), textured(128, 900)
    truth = torch.full((128, 800), 2.0)
    truth[:, 300:500] = 30.0
    left = ground[:, 40:840].clone()
    left[:, 300:500] = front[:, 300:500]
    right = ground[:, 42:842].clone()
    right[:, 270:470] = front[:, 300:500]
    return left, right, truth


@pytest.mark.parametrize("shift", [-20, -7, 0, 11, 23])
def test_constant_shift_is_recovered_with_its_sign(shift):
    disparity = match(*pair(shift))
    known = torch.isfinite(disparity)
    partner = torch.arange(280) - shift
    seen = (partner >= 0) & (partner < 280)
    assert known[:, seen].float().mean() > 0.9
    assert (disparity[known] - shift).square().mean().sqrt() < 0.1
    refined_partner = torch.arange(280) - disparity  # by a fraction of a pixel
    assert not (known & ((refined_partner < -0.5) | (refined_partner > 279.5))).any()


def test_both_surfaces_beside_an_edge(step):
    left, right, truth = step
    disparity = match(left, right)
    error = (disparity - truth).abs()
    known = torch.isfinite(disparity)
    hidden = torch.zeros(800, dtype=torch.bool)
    hidden[272:300] = True  # from the right camera
    hidden[:2] = True
    assert (known & (error > 1))[:, ~hidden].float().mean() < 0.005
    assert known[:, ~hidden].float().mean() > 0.97
    assert known[:, 276:296].float().mean() < 0.1
    beside = [*range(262, 270), *range(302, 310), *range(490, 498), *range(502, 510)]
    assert (error[:, beside] < 1).float().mean() > 0.85


def test_small_pits_are_found_where_the_small_copy_sees_none():
    generator = torch.Generator().manual_seed(3)
    right = textured(256, 880)[..., 0].float()
    v, u = torch.meshgrid(torch.arange(256.0), torch.arange(800.0), indexing="ij")
    distance = ((u % 100 - 50).square() + (v % 64 - 32).square()).sqrt()  # from the nearest pit's middle
    truth = torch.where(distance < 14, 7.0, 4.0)
    left = right.gather(1, (u - truth + 40).long())
    noisy = (image + 2 * torch.randn(image.shape, generator=generator) for image in (left, right[:, 40:840]))
    disparity = match(*(image.clamp(0, 255).round().to(torch.uint8)[..., None] for image in noisy))
    inside = ((disparity - truth)[distance < 12]).abs()
    assert (inside <= 1).float().mean() > 0.75
    assert (inside > 1).float().mean() < 0.1


def test_odd_sizes_have_a_value_for_each_incomplete_block():
    left, right = (image[:95, :279] for image in pair(6))
    start = match_coarse_to_fine(GrayPair.of(left, right), search(-40, 40), fine_check_px=4, noise=1.0)
    assert start.shape == (48, 140)
    assert (start[:, 10:-3] - 6).abs().nanmedian() < 0.1
    assert match(left, right).shape == (95, 279)


def test_nothing_is_invented():
    assert torch.isfinite(match(*pair(20), -9, 9)).float().mean() < 0.05
    left, right = pair(5)
    swapped = match(right, left, 2, 40)
    assert torch.isfinite(swapped).float().mean() < 0.05


def test_types_and_colours():
    left, right = pair(6)
    eight = match(left, right)
    for images in (
        (image.to(torch.int32).mul(257).to(torch.uint16) for image in (left, right)),
        (image.expand(-1, -1, 3) for image in (left, right)),
    ):
        other = match(*images)
        both = torch.isfinite(eight) & torch.isfinite(other)
        assert both.float().mean() > 0.85
        assert (eight - other)[both].abs().mean() < 0.02


def test_a_strip_differs_little_from_the_whole(step):
    # Read from a scan it does not differ at all: strips lie at fixed lines there.
    left, right, _ = step
    whole, part = match(left, right), match(left[32:], right[32:])
    both = torch.isfinite(whole[72:]) & torch.isfinite(part[40:])
    assert both.float().mean() > 0.9
    assert ((whole[72:] - part[40:])[both].abs() > 0.02).float().mean() < 0.06


def test_bad_input():
    left, right = pair(0)
    with pytest.raises(ValueError, match="one shape"):
        match(left, right[1:])
    with pytest.raises(ValueError, match="maximum_px"):
        match(left, right, 5, 5)
