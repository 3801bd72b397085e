"""Sub-pixel refinement: unbiased on pairs of known shift, and humble where nothing can be known."""

import math

import pytest
import torch

from lsvision.image.stereo.refine import _warp_rows, enlarged, refine_disparity
from lsvision.image.stereo.sgbm import match_sgbm
from tests.image.stereo.test_sgbm import OPTIONS

LINES, WIDTH = 64, 240
INSIDE = (slice(8, -8), slice(24, -24))
REFINE = {"window": 9, "iterations": 2, "noise": 0.5}


def refine(*images, **options):
    return refine_disparity(*images, **options).disparity


def texture(shift: torch.Tensor, noise: float = 0.0) -> torch.Tensor:
    """A sum of waves of 8 to 28 px, seen at u + shift: band-limited, so that its value is known between the pixels."""
    generator = torch.Generator().manual_seed(5)
    count = 60
    length = 8.0 + 20.0 * torch.rand(count, generator=generator)
    heading = 2 * math.pi * torch.rand(count, generator=generator)
    phase = 2 * math.pi * torch.rand(count, generator=generator)
    v, u = torch.meshgrid(torch.arange(LINES).float(), torch.arange(WIDTH).float(), indexing="ij")
    across = torch.cos(heading) / length, torch.sin(heading) / length
    waves = across[0][:, None, None] * (u + shift) + across[1][:, None, None] * v
    return 120 + 7.0 * torch.sin(2 * math.pi * waves + phase[:, None, None]).sum(0) + noise * torch.randn(LINES, WIDTH)


@pytest.mark.parametrize("shift", [-3.4, 0.25, 2.5, 7.8])
def test_known_shift_is_recovered_without_bias(shift):
    left, right = texture(torch.tensor(0.0), 0.5), texture(torch.tensor(shift), 0.5)
    start = torch.full((LINES, WIDTH), float(round(shift)))
    error = (refine(left, right, start, **REFINE) - shift)[INSIDE]
    assert error.square().mean().sqrt() < 0.05
    assert abs(error.mean()) < 0.005


def test_pixel_locking_of_the_matcher_is_removed():
    slope = 4.0 / WIDTH  # disparities of 0..4 px, every fraction of a pixel equally often
    u = torch.arange(WIDTH).float()
    right = texture(torch.tensor(0.0), 0.5)
    truth = (u * slope).expand(LINES, WIDTH)
    left = texture(-truth, 0.5)  # left sees at u what right sees at u - d
    pair = [image.clamp(0, 255).round().to(torch.uint8)[..., None] for image in (left, right)]
    matched = match_sgbm(*pair, minimum_px=-8, maximum_px=12, **OPTIONS)
    refined = refine(left, right, matched, **REFINE)

    def error_by_phase(disparity):
        """Bias by the fraction of the true disparity, in eight bins."""
        error, phase = (disparity - truth)[INSIDE], (truth % 1.0)[INSIDE]
        bins = (8 * phase).long()
        return torch.stack([error[bins == k].nanmean() for k in range(8)])

    assert torch.isfinite(matched[INSIDE]).float().mean() > 0.95
    error = (refined - truth)[INSIDE]
    error = error[torch.isfinite(error)]
    assert error.square().mean().sqrt() < 0.05
    assert abs(error.mean()) < 0.005
    locked, left_over = (error_by_phase(disparity).abs().max() for disparity in (matched, refined))
    assert left_over < 0.015 < 0.03 < locked


def test_untextured_ground_stays():
    start = 3.0 + 0.01 * torch.arange(WIDTH).float().expand(LINES, WIDTH)
    left, right = (100 + 0.5 * torch.randn(LINES, WIDTH) for _ in "ab")
    refined = refine(left, right, start, **REFINE)
    assert (refined - start)[INSIDE].abs().mean() < 0.25  # as little as matching itself knows
    flat = torch.full((LINES, WIDTH), 100.0)
    torch.testing.assert_close(refine(flat, flat, start, **REFINE)[INSIDE], start[INSIDE])


def test_missing_stays_missing_and_pulls_nothing():
    shift = 2.4
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(shift))
    start = torch.full((LINES, WIDTH), 2.0)
    start[20:40, 100:140] = torch.nan
    refined = refine(left, right, start, **REFINE)
    assert torch.equal(refined.isnan(), start.isnan())
    assert (refined - shift)[INSIDE].abs().nan_to_num().mean() < 0.01
    around = (slice(12, 48), slice(92, 148))
    assert (refined - shift)[around].abs().nan_to_num().max() < 0.1
    assert refine(left, right, torch.full_like(start, torch.nan), **REFINE).isnan().all()


def test_brightness_offset_changes_nothing():
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(1.3))
    start = torch.ones(LINES, WIDTH)
    refined = refine(left, right, start, **REFINE)
    torch.testing.assert_close(refine(left + 30, right - 20, start, **REFINE), refined, rtol=0, atol=1e-3)


def test_a_large_change_is_undone():
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(0.9))
    start = torch.zeros(LINES, WIDTH)
    refined = refine(left, right, start, window=9, iterations=4, noise=1.0, largest_change_px=0.3)
    assert (refined[INSIDE] == 0).float().mean() > 0.95


def test_warp_by_hand():
    image = torch.tensor([[0.0, 1.0, 4.0, 9.0, 16.0, 25.0, 36.0]])  # u squared, which the cubic keeps
    expected = (torch.arange(7.0)[None] - 0.5) ** 2
    torch.testing.assert_close(_warp_rows(image, torch.full((1, 7), 0.5))[:, 2:6], expected[:, 2:6])
    torch.testing.assert_close(_warp_rows(image, torch.full((1, 7), -1.0))[:, 1:5], image[:, 2:6])


def test_blocks_of_pixels_are_refined_by_all_their_pixels():
    slope = 4.0 / WIDTH
    truth = (torch.arange(WIDTH).float() * slope).expand(LINES, WIDTH)
    left, right = texture(-truth, 0.5), texture(torch.tensor(0.0), 0.5)
    start = truth[::2, ::2].round()
    for lines, width in ((LINES, WIDTH), (LINES - 1, WIDTH - 1)):
        refined = refine(left[:lines, :width], right[:lines, :width], start, **REFINE)
        assert refined.shape == (lines, width)
        error = (refined - truth[:lines, :width])[INSIDE]
        assert error.square().mean().sqrt() < 0.05
        assert abs(error.mean()) < 0.005
    with pytest.raises(ValueError, match="2 x 2"):
        refine(left, right, start[1:], **REFINE)


@pytest.mark.parametrize("block", [1, 2])
def test_a_part_of_the_left_image_finds_its_partners_in_the_whole_right_one(block):
    left, right = texture(torch.tensor(0.0), 0.5), texture(torch.tensor(7.3), 0.5)
    start = torch.full((LINES, WIDTH), 7.0)[::block, ::block]
    first = 80
    part = refine(left[:, first:160], right, start[:, first // block : 160 // block], first_column=first, **REFINE)
    whole = refine(left, right, start, **REFINE)[:, first:160]
    margin = 20
    torch.testing.assert_close(part[:, margin:-margin], whole[:, margin:-margin], rtol=0, atol=1e-4)


def test_an_edge_between_blocks_stays_sharp():
    disparity = torch.tensor([[2.0, 2.0, 32.0, math.nan], [2.4, 2.4, 32.0, math.nan]])
    pixels = enlarged(disparity, 2)
    assert pixels.shape == (4, 8)
    torch.testing.assert_close(pixels[:, 0], torch.tensor([2.0, 2.1, 2.3, 2.4]))
    assert (pixels[:, 4:6] == 32.0).all()
    assert (pixels[:, 2:4] < 3.0).all()
    assert pixels[:, 6:].isnan().all()
