"""Values of blocks and of pixels: shapes, edges, gaps."""

import math

import cv2
import pytest
import torch

from lsvision.image.stereo.blocks import block_side, enlarged, repeated, whole_blocks


def test_an_edge_between_blocks_stays_sharp():
    disparity = torch.tensor([[2.0, 2.0, 32.0, math.nan], [2.4, 2.4, 32.0, math.nan]])
    pixels = enlarged(disparity, 2)
    assert pixels.shape == (4, 8)
    torch.testing.assert_close(pixels[:, 0], torch.tensor([2.0, 2.1, 2.3, 2.4]))
    assert (pixels[:, 4:6] == 32.0).all()
    assert (pixels[:, 2:4] < 3.0).all()
    assert pixels[:, 6:].isnan().all()
    assert (enlarged(disparity, 2, largest_step_px=0.05)[:, :4] == repeated(disparity, 2)[:, :4]).all()


def test_enlarged_is_the_interpolated_value_where_it_is_close_to_that_of_the_block():
    generator = torch.Generator().manual_seed(0)
    disparity = torch.rand(70, 33, generator=generator).cumsum(1) + 9 * (torch.rand(70, 33, generator=generator) > 0.9)
    disparity[torch.rand(70, 33, generator=generator) > 0.95] = math.nan
    own = repeated(disparity, 2)
    smooth = torch.from_numpy(cv2.resize(disparity.numpy(), (66, 140), interpolation=cv2.INTER_LINEAR))
    expected = torch.where((smooth - own).abs() < 4.0, smooth, own)
    torch.testing.assert_close(enlarged(disparity, 2), expected, rtol=0, atol=0, equal_nan=True)
    wide = disparity.repeat(1, 2)
    assert torch.equal(enlarged(wide[:, :33], 2).isnan(), expected.isnan())


def test_incomplete_blocks_repeat_the_edge():
    image = torch.arange(15, dtype=torch.uint8).view(3, 5)
    whole = whole_blocks(image, slice(0, 2), 2)
    assert whole.dtype == torch.float32
    assert whole[3].tolist() == [10, 11, 12, 13, 14, 14]
    assert whole[:, 5].tolist() == [4, 9, 14, 14]
    assert torch.equal(whole_blocks(image, slice(1, 2), 2), whole[2:])


def test_the_side_of_a_block_follows_from_the_shapes():
    image = torch.zeros(5, 8)
    assert block_side(image, torch.zeros(5, 8)) == 1
    assert block_side(image, torch.zeros(3, 4)) == 2
    with pytest.raises(ValueError, match="2 x 2"):
        block_side(image, torch.zeros(2, 4))
