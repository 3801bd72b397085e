"""Smoothing for coarser samples: by hand, on every axis, and independent of the part of the image."""

import math

import pytest
import torch

from lsvision.image.smoothing import smoothed, smoothing_radius


def test_a_line_by_hand():
    # Samples three columns apart: a Gaussian of sqrt(8) / 2 px, cut off at 3 sigma.
    image = torch.zeros(1, 31, 1)
    image[:, 15] = 1000.0
    assert smoothing_radius(3.0) == 5
    weights = [math.exp(-0.5 * (k / math.sqrt(2)) ** 2) for k in range(-5, 6)]
    expected = torch.zeros(21)
    expected[5:16] = 1000 * torch.tensor(weights) / sum(weights)
    torch.testing.assert_close(smoothed(image, 1, 3.0).flatten(), expected, rtol=1e-5, atol=1e-3)


def test_no_smoothing_up_to_a_spacing_of_one():
    image = torch.randint(0, 256, (4, 5, 3), dtype=torch.uint8)
    assert smoothing_radius(1.0) == 0
    assert smoothed(image, 0, 0.5) is image


@pytest.mark.parametrize("axis", [0, 1])
def test_a_part_of_the_image_changes_no_bit(axis):
    image = torch.rand(60, 70, 2)
    whole = smoothed(image, axis, 2.5)
    part = smoothed(image.narrow(axis, 7, 40), axis, 2.5)
    assert torch.equal(part, whole.narrow(axis, 7, part.shape[axis]))
