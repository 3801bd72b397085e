"""Windows around corners: which pixels they hold, read by line ranges, and which of them lie in the four squares."""

import math

import torch

from lsvision.image.board.refine import GridSteps, lies_within, read_windows
from lsvision.types import TensorImage


def square_grid(step: float) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(3), torch.arange(4), indexing="ij")
    return step * torch.stack([x, y], dim=-1).double()


def test_windows_are_slices_of_the_image():
    image = torch.randint(0, 256, (1300, 60, 1)).to(torch.uint8)
    centre = torch.tensor([[10, 8], [30, 510], [31, 513], [50, 1024], [3, 100], [30, 1297]])
    inside = lies_within(TensorImage(image), centre, 5)
    assert inside.tolist() == [True, True, True, True, False, False]
    windows, brightest = read_windows(TensorImage(image), centre, inside, 5)
    assert torch.equal(brightest, windows)
    for window, (u, v), seen in zip(windows, centre.tolist(), inside.tolist(), strict=True):
        expected = image[v - 5 : v + 6, u - 5 : u + 6, 0].double() if seen else torch.zeros(11, 11).double()
        assert torch.equal(window, expected)


def test_the_brightest_colour_of_each_pixel():
    image = torch.randint(0, 200, (30, 30, 3)).to(torch.uint8)
    image[12, 13, 0] = 255
    centre, inside = torch.tensor([[15, 15]]), torch.ones(1, dtype=torch.bool)
    windows, brightest = read_windows(TensorImage(image), centre, inside, 5)
    assert torch.equal(brightest[0], image[10:21, 10:21].amax(-1).double())
    assert brightest[0, 2, 3] == 255 > windows[0, 2, 3]


def test_steps_of_a_square_grid():
    steps = GridSteps.of(square_grid(20.0))
    assert steps.along_x.tolist() == [[20.0, 0.0]] * 12
    assert steps.along_y.tolist() == [[0.0, 20.0]] * 12
    torch.testing.assert_close(steps.normal_angles()[0], torch.tensor([math.pi / 2, math.pi]).double())
    assert [steps.window_radius(largest) for largest in (13, 6)] == [8, 6]


def test_pixels_well_within_the_squares():
    # Four tenths of 20 px are 8 px, exclusive.
    mask = GridSteps.of(square_grid(20.0)).within_squares(10)
    assert mask.shape == (12, 21, 21)
    assert mask.sum((1, 2)).tolist() == [15 * 15] * 12
    assert mask[0, 3:18, 3:18].all()
    # Squares of 5 px hold 3 x 3 such pixels, too few: the whole window is used.
    assert GridSteps.of(square_grid(5.0)).within_squares(4).all()
