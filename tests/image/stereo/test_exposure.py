"""The exposure of one image relative to another: known factors are recovered, outliers change nothing."""

import pytest
import torch

from lsvision.image.stereo.exposure import Exposure, fit_exposure

PIXELS = 4000


@pytest.fixture
def matched():
    """Brightness of the left image and positions in the right one."""
    return 20 + 200 * torch.rand(PIXELS), torch.rand(PIXELS)


def test_factors_along_a_line_are_applied_as_stated():
    exposure = Exposure(torch.linspace(1.0, 2.0, 13, dtype=torch.float64), -5.0, 0.1)
    values = exposure.apply(torch.tensor([[100, 100, 100, 0, 255]], dtype=torch.uint8))
    square = 0.1 * 100**2 / 255
    expected = torch.tensor([100 + square, 1.25 * (100 + square), 1.5 * (100 + square), 5.0, 260.0])[None] - 5
    torch.testing.assert_close(values, expected)


@pytest.mark.parametrize("gain", [0.6, 1.25])
@pytest.mark.parametrize("offset", [-10.0, 10.0])
def test_gain_and_offset_of_a_camera_are_recovered(matched, gain, offset):
    left, position = matched
    right = gain * left + offset + 0.3 * torch.randn(PIXELS)
    right[::5] = 255 * torch.rand(PIXELS // 5)  # wrong matches
    exposure = fit_exposure(left, right, position)
    assert exposure is not None
    restored = exposure.apply((gain * left + offset)[None])[0]
    for part in (slice(0, 500), slice(500, 1000)):  # the gain at any place of a line
        line = torch.full((1, 1000), gain * 128 + offset)
        assert (exposure.apply(line)[0, part] - 128).abs().max() < 2.0
    assert (restored - left).abs().median() < 1.0


def test_vignetting_and_a_tone_curve_are_recovered(matched):
    left, position = matched
    right = 255 * (left / 255 * (1 - 0.45 * (2 * position - 1).square())).pow(0.8)
    exposure = fit_exposure(left, right, position)
    assert exposure is not None
    columns = torch.linspace(0, 1, 1000)
    for level in (50.0, 120.0, 200.0):
        seen = 255 * (level / 255 * (1 - 0.45 * (2 * columns - 1).square())).pow(0.8)
        assert (exposure.apply(seen[None])[0] - level).square().mean().sqrt() < 5.0


def test_equal_images_have_no_exposure(matched):
    left, position = matched
    right = left + 0.5 * torch.randn(PIXELS)
    assert fit_exposure(left, right, position) is None
    right[::10] += 60  # gloss that one camera sees
    assert fit_exposure(left, right, position) is None
    assert fit_exposure(left[:300], 0.5 * right[:300], position[:300]) is None  # too few to know


def test_a_gloss_on_an_object_of_one_brightness_is_no_tone_curve():
    """Only one camera sees it: no camera has the steep curve that would explain it."""
    position = torch.rand(PIXELS)
    left = 60 + 6 * torch.randn(PIXELS)
    right = (left + 0.3 * torch.randn(PIXELS) + 120 * torch.exp(-(((position - 0.5) / 0.15) ** 2))).clamp(0, 255)
    exposure = fit_exposure(left, right, position)
    assert exposure is None or exposure.is_plausible
    assert not Exposure(torch.tensor([0.2, -0.04], dtype=torch.float64), 39.7, 8.8).is_plausible
