"""Dense matching: the disparity's sign, value, range and gaps."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from lsvision.image.stereo.sgbm import GrayPair, Search, match_sgbm


def search(low: int, high: int) -> Search:
    """The default settings over a range of disparities."""
    return Search(
        minimum_px=low,
        maximum_px=high,
        block_size=5,
        small_change_penalty=200,
        large_change_penalty=800,
        left_right_check_px=10,
        uniqueness_percent=5,
        speckle_px=100,
    )


def textured(lines: int = 80, width: int = 200) -> torch.Tensor:
    noise = F.avg_pool2d(torch.rand(1, 1, lines + 2, width + 2), 3, 1)[0, 0]
    return (40 + 175 * (noise - noise.min()) / (noise.max() - noise.min())).to(torch.uint8)[..., None]


def pair(shift: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Left and right strips of a plane of the given disparity: what left sees at u, right sees at u - shift."""
    wide = textured(width=260)
    return wide[:, 30:230], wide[:, 30 + shift : 230 + shift]


def match(left, right, low=-24, high=24):
    return match_sgbm(GrayPair.of(left, right), search(low, high))


@pytest.mark.parametrize("shift", [-20, -7, 0, 11, 23])
def test_constant_shift_is_recovered_with_its_sign(shift):
    disparity = match(*pair(shift))
    known = torch.isfinite(disparity)
    partner = torch.arange(200) - shift
    seen = (partner >= 0) & (partner < 200)
    assert known[:, seen].float().mean() > 0.9
    assert (disparity[known] - shift).abs().max() <= 1.0
    assert (disparity[known] - shift).square().mean().sqrt() < 0.1
    # A match of what right does not see would lie outside its image.
    assert not (known & ((torch.arange(200) - disparity < 0) | (torch.arange(200) - disparity > 199))).any()


def test_bounds_of_the_range_are_within_it():
    for shift in (-9, 9):
        disparity = match(*pair(shift), -9, 9)
        assert (disparity[:, 20:180].nanmedian() - shift).abs() < 0.1


def test_disparities_beyond_the_range_are_not_invented():
    disparity = match(*pair(20), -9, 9)
    assert torch.isfinite(disparity).float().mean() < 0.05


def test_sixteen_bits_match_as_eight():
    left, right = pair(6)
    eight = match(left, right)
    sixteen = match(left.to(torch.int32).mul(257).to(torch.uint16), right.to(torch.int32).mul(257).to(torch.uint16))
    both = torch.isfinite(eight) & torch.isfinite(sixteen)
    assert both.float().mean() > 0.9
    assert (eight - sixteen)[both].square().mean().sqrt() < 0.05


def test_faint_sixteen_bit_images_keep_their_texture():
    left, right = (image.to(torch.int32).add(500).to(torch.uint16) for image in pair(6))
    disparity = match(left, right)
    assert torch.isfinite(disparity).float().mean() > 0.9
    assert (disparity.nanmedian() - 6).abs() < 0.1


def test_sixteen_bit_pairs_share_one_scale():
    left, right = (image.to(torch.int32).mul(200).to(torch.uint16) for image in pair(6))
    left[0, 0] = 65535  # a glint that only one camera sees
    disparity = match(left, right)
    assert torch.isfinite(disparity).float().mean() > 0.85
    assert (disparity.nanmedian() - 6).abs() < 0.1


def test_colour_is_matched_by_its_brightness():
    left, right = pair(5)
    torch.testing.assert_close(
        match(left.expand(-1, -1, 3), right.expand(-1, -1, 3)), match(left, right), equal_nan=True
    )


def test_bad_input():
    left, right = pair(0)
    with pytest.raises(ValueError, match="one shape"):
        match(left, right[1:])
    with pytest.raises(ValueError, match="maximum_px"):
        match(left, right, 5, 5)
