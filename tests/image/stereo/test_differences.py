"""Differences along lines, by hand."""

import torch

from lsvision.image.stereo.differences import second_difference, slope


def test_by_hand():
    image = torch.tensor([[0.0, 1.0, 4.0, 9.0, 16.0], [5.0, 5.0, 2.0, 2.0, 8.0]])
    assert slope(image).tolist() == [[0.0, 2.0, 4.0, 6.0, 0.0], [0.0, -1.5, -1.5, 3.0, 0.0]]
    assert second_difference(image).tolist() == [[0.0, 2.0, 2.0, 2.0, 0.0], [0.0, -3.0, 3.0, 6.0, 0.0]]


def test_a_part_of_an_image():
    """The columns beside it do not count."""
    image = torch.arange(40.0).square().view(4, 10)
    for difference in (slope, second_difference):
        torch.testing.assert_close(difference(image[1:3, 2:7]), difference(image[1:3, 2:7].clone()))
