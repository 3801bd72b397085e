"""Sampling strips: exact on the grid, right between, the same for any number of threads and any strip."""

import math

import pytest
import torch

from lsvision.image.resampling import Sampling, sample_image, sample_images, sampling_reach


def positions(lines: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    line, column = torch.meshgrid(torch.arange(lines).double(), torch.arange(width).double(), indexing="ij")
    return column, line


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16])
def test_identity_is_exact(dtype, mode):
    image = torch.randint(0, torch.iinfo(dtype).max + 1, (40, 33, 3)).to(dtype)
    sampled = sample_image(image, *positions(40, 33), Sampling(mode))
    assert sampled.dtype == dtype
    assert torch.equal(sampled.int(), image.int())


def test_half_pixels_by_hand():
    image = torch.tensor([[0, 100, 200], [40, 60, 80]], dtype=torch.uint8)[..., None]
    column, line = torch.tensor([[0.5, 1.5, 1.0]]).double(), torch.tensor([[0.0, 0.5, 0.5]]).double()
    assert sample_image(image, column, line, Sampling("bilinear")).flatten().tolist() == [50, 110, 80]
    # Catmull-Rom-like cubic of a = -0.75 halfway: weights -3/32, 19/32, 19/32, -3/32 on 0, 8, 24, 16.
    row = torch.tensor([[0.0, 8.0, 24.0, 16.0]])[..., None]
    halfway = sample_image(row, torch.tensor([[1.5]]).double(), torch.zeros(1, 1).double(), Sampling("bicubic"))
    assert halfway.item() == (19 * (8 + 24) - 3 * (0 + 16)) / 32


def test_bilinear_equals_the_naive_sum():
    image = torch.rand(12, 17, 2)
    column, line = 16 * torch.rand(9, 5).double(), 11 * torch.rand(9, 5).double()
    sampled = sample_image(image, column, line, Sampling("bilinear"))
    for i in range(9):
        for j in range(5):
            u, v = float(column[i, j]), float(line[i, j])
            a, b = min(int(u), 15), min(int(v), 10)
            s, t = u - a, v - b
            upper = (1 - s) * image[b, a] + s * image[b, a + 1]
            lower = (1 - s) * image[b + 1, a] + s * image[b + 1, a + 1]
            torch.testing.assert_close(sampled[i, j], (1 - t) * upper + t * lower, rtol=0, atol=2e-3)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_beyond_the_rim_is_the_rim_and_nan_is_zero(mode):
    image = torch.randint(1, 256, (5, 6, 3)).to(torch.uint8)
    column = torch.tensor([[-3.0, 9.0, 2.0, torch.nan, 1.0]]).double()
    line = torch.tensor([[1.0, 1.0, 40.0, 1.0, torch.nan]]).double()
    sampled = sample_image(image, column, line, Sampling(mode))[0]
    assert torch.equal(sampled, torch.stack([image[1, 0], image[1, 5], image[4, 2], 0 * image[0, 0], 0 * image[0, 0]]))


def test_overshoot_is_clamped():
    image = torch.tensor([0, 0, 255, 255], dtype=torch.uint8).reshape(1, 4, 1)
    column = torch.linspace(0, 3, 31).double()[None]
    sampled = sample_image(image, column, torch.zeros_like(column), Sampling("bicubic")).flatten()
    assert (sampled.int().diff() >= -20).all()  # no wrap from 255 to 0
    assert sampled[-1] == 255


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_threads_change_no_bit(mode):
    image = torch.randint(0, 65536, (50, 60, 3)).to(torch.uint16)
    column, line = 59 * torch.rand(37, 41).double(), 49 * torch.rand(37, 41).double()
    single = sample_image(image, column, line, Sampling(mode))
    torch.set_num_threads(2)
    assert torch.equal(sample_image(image, column, line, Sampling(mode)).int(), single.int())


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_strip_around_a_position_changes_no_bit(mode):
    image = torch.randint(0, 65536, (300, 700, 1)).to(torch.uint16)
    column, line = 699 * torch.rand(100, 300).double(), 110 + 80 * torch.rand(100, 300).double()
    whole = sample_image(image, column, line, Sampling(mode))
    for start, stop in ((100, 200), (3, 261), (107, 194)):
        part = sample_image(image[start:stop], column, line - start, Sampling(mode))
        assert torch.equal(part.int(), whole.int())


@pytest.mark.parametrize("resampler", ["grid_sample", "opencv"])
@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_several_images_at_once_equal_each_alone(mode, resampler):
    color, depth = torch.randint(0, 256, (50, 60, 3)).to(torch.uint8), 800 + torch.randn(50, 60, 1)
    column, line = 59 * torch.rand(37, 41).double(), 49 * torch.rand(37, 41).double()
    column[torch.rand(37, 41) < 0.2] = torch.nan
    both = sample_images((color, depth), column, line, Sampling(mode, resampler))
    for image, sampled in zip((color, depth), both, strict=True):
        assert torch.equal(sampled, sample_image(image, column, line, Sampling(mode, resampler)))


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@pytest.mark.parametrize("coarser", [(1.0, 1.0), (2.5, 1.5)])
def test_opencv_agrees(mode, coarser):
    color, height = torch.randint(0, 256, (50, 60, 3)).to(torch.uint8), 10 * torch.randn(50, 60, 1)
    column, line = -3 + 66 * torch.rand(37, 41).double(), -3 + 56 * torch.rand(37, 41).double()
    column[torch.rand(37, 41) < 0.2] = torch.nan
    ours, theirs = (
        sample_images((color, height), column, line, Sampling(mode, resampler, coarser))
        for resampler in ("grid_sample", "opencv")
    )
    assert (ours[0].int() - theirs[0].int()).abs().max() <= 1
    assert (ours[1] - theirs[1]).abs().max() <= 1e-4


def test_smoothing_by_hand():
    # A single bright column, samples three columns apart: a Gaussian of sqrt(8) / 2 px, cut off at 3 sigma.
    image = torch.zeros(9, 31, 1)
    image[:, 15] = 1000.0
    column, line = torch.arange(31).double()[None], torch.full((1, 31), 4.0).double()
    sampled = sample_image(image, column, line, Sampling("bilinear", coarser=(1.0, 3.0))).flatten()
    assert sampling_reach(3.0) == 2 + 5
    weights = [math.exp(-0.5 * (k / math.sqrt(2)) ** 2) for k in range(-5, 6)]
    expected = torch.zeros(31)
    expected[10:21] = 1000 * torch.tensor(weights) / sum(weights)
    torch.testing.assert_close(sampled, expected, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(
        sample_image(image + 7, column, line, Sampling("bilinear", coarser=(4.0, 3.0))), sampled[None, :, None] + 7
    )


def test_positions_too_far_apart_are_refused():
    image = torch.zeros(2, 9000, 1)
    with pytest.raises(ValueError, match="spread of at most 8192 px, got 9003"):
        sample_image(image, torch.tensor([[0.0, 8998.0]]).double(), torch.zeros(1, 2).double(), Sampling("bilinear"))
