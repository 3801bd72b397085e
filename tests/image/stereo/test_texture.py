"""What texture proves: nothing in noise, all in texture, and less the farther it lies from the centre."""

import pytest
import torch

from lsvision.image.stereo.shift import LeftWindows
from lsvision.image.stereo.texture import TextureSupport, texture_support
from lsvision.image.stereo.windows import Windows
from tests.image.stereo.test_refine import texture

LINES, WIDTH, WINDOW = 64, 240, 9


def support(left: torch.Tensor, noise: float, block: int = 1, confidence: float = 4.0) -> TextureSupport:
    """Of an image whose match leaves just the noise of both images."""
    every = torch.ones(LINES // block, WIDTH // block, dtype=torch.bool)
    windows = Windows.over(every, 2 * (WINDOW // (2 * block)) + 1)
    equations = LeftWindows.of(left, windows, noise=2.0, with_gain=False)
    return texture_support(equations, torch.full_like(windows.weight, max(1.6 * noise**2, 1 / 6)), confidence)


def noisy(noise: float, seed: int = 3) -> torch.Tensor:
    return 90 + noise * torch.randn(LINES, WIDTH, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("noise", [0.7, 1.0, 2.0, 20.0])
def test_noise_alone_proves_nothing(noise, block):
    assert support(noisy(noise), noise, block).proven.float().mean() < 0.003


@pytest.mark.parametrize("block", [1, 2])
def test_texture_beyond_noise_is_proven(block):
    found = support(texture(torch.zeros(())) + noisy(1.0) - 90, 1.0, block)
    assert found.proven.float().mean() > 0.995
    assert found.variance.sqrt().median() < 0.01


def test_more_confidence_needs_more_texture():
    left = 90 + 0.1 * (texture(torch.zeros(())) - 120) + noisy(1.0) - 90
    shares = [float(support(left, 1.0, confidence=c).proven.float().mean()) for c in (1.0, 4.0, 12.0)]
    assert shares[0] > shares[1] > shares[2]


@pytest.mark.parametrize("block", [1, 2])
def test_an_edge_says_less_about_places_farther_from_it(block):
    edge = 100
    left = torch.full((LINES, WIDTH), 40.0)
    left[:, edge:] = 200.0
    sigma = support(left + noisy(0.5) - 90, 0.5, block).variance.sqrt()[16 // block]
    at = [float(sigma[(edge + step) // block]) for step in (0, 2, 4)]
    assert at[0] < 0.05
    assert at[0] < at[1] < at[2]
    assert at[2] > 0.12
