"""Reference scans without a renderer: columns of a known response see a white with dirt on it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.types import CameraResponse, TensorImage

WIDTH, LINES = 300, 400


@dataclass(frozen=True)
class Made:
    """A dark and a white reference, and the response of the camera that took them."""

    dark: TensorImage
    white: TensorImage
    response: CameraResponse


def make(seed: int = 0, *, level: float = 180.0, dirt: float = 0.03, speed: float = 1.0, noise: float = 1.5) -> Made:
    """References of a camera that loses 40 % at its ends, of 5 % noise of the gains.

    Args:
        level: codes of white. dirt: share of it that is dirty. speed: 0 for one that does not move. noise: codes.
    """
    chance = torch.Generator().manual_seed(seed)
    end = torch.linspace(-1, 1, WIDTH)[:, None]
    gain = (1 - 0.4 * end.square()) * (1 + 0.05 * torch.randn(WIDTH, 3, generator=chance))
    response = CameraResponse(3 + torch.randn(WIDTH, 3, generator=chance), gain)
    seen = level * scene(dirt, speed, 100)[..., None] * gain + response.offset
    return Made(taken(response.offset.expand(LINES, -1, -1), noise, chance), taken(seen, noise, chance), response)


def scene(dirt: float, speed: float, seed: int) -> Tensor:
    """Reflectance of a white with specks of a few pixels, line by line."""
    chance = torch.Generator().manual_seed(seed)
    specks = torch.rand(LINES // 5 + 1, WIDTH // 5, generator=chance) < dirt
    plate = 1 - 0.4 * specks.repeat_interleave(5, 0).repeat_interleave(5, 1).float()
    lines = (torch.arange(LINES) * speed).long()
    return plate[lines]


def taken(values: Tensor, noise: float, chance: torch.Generator) -> TensorImage:
    """Bytes of a camera with noise."""
    noisy = values + noise * torch.randn(values.shape, generator=chance)
    return TensorImage(noisy.round().clamp(0, 255).to(torch.uint8))
