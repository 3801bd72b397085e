"""Warping lines: by hand, and against the interpolation formula at every pixel."""

import torch

from lsvision.image.stereo.warp import warp_cubic, warp_linear


def test_the_cubic_by_hand():
    image = torch.tensor([[0.0, 1.0, 4.0, 9.0, 16.0, 25.0, 36.0]])  # u squared, which the cubic keeps
    expected = (torch.arange(7.0)[None] - 0.5) ** 2
    torch.testing.assert_close(warp_cubic(image, torch.full((1, 7), 0.5))[:, 2:6], expected[:, 2:6])
    torch.testing.assert_close(warp_cubic(image, torch.full((1, 7), -1.0))[:, 1:5], image[:, 2:6])
    torch.testing.assert_close(warp_cubic(image, torch.full((1, 2), 0.5), 3), expected[:, 3:5])


def test_linear_interpolation_by_hand():
    image = torch.tensor([[0, 100, 200], [40, 60, 80]], dtype=torch.uint8)
    column = torch.tensor([[0.5, -3.0], [1.25, 9.0]])
    assert warp_linear(image, column).tolist() == [[50, 0], [65, 80]]
