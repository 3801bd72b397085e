"""Synthetic checkerboard corners of known position, angle and blur."""

import math

import pytest
import torch
from torch import Tensor

SIZE = 17


def saddle_windows(
    position: Tensor, angles: Tensor, blur: Tensor, contrast: float = 90.0, line_shift: Tensor | None = None
) -> Tensor:
    """Windows ``(corners, size, size)`` around a corner at (u, v) from the centre; grey 120 in the mean.

    Each line is shifted by ``line_shift``, (corners, size, 2), in u and v.
    """
    if line_shift is None:
        line_shift = torch.zeros(1, SIZE, 2, dtype=torch.float64)
    position = position[:, None, None] + line_shift[:, :, None]
    axis = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    edges = []
    for k in (0, 1):
        distance = (u - position[..., 0]) * angles[:, k].cos()[:, None, None]
        distance = distance + (v - position[..., 1]) * angles[:, k].sin()[:, None, None]
        edges.append(torch.erf(distance / (math.sqrt(2.0) * blur[:, None, None])))
    return 120.0 + contrast * edges[0] * edges[1]


def random_corners(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions within 1.5 px of the centre, edge normals 60 to 120 degrees apart, blurs of 0.5 to 1.5 px."""
    position = 3 * torch.rand(count, 2, dtype=torch.float64) - 1.5
    first = 2 * math.pi * torch.rand(count, dtype=torch.float64)
    second = first + math.radians(60) + math.radians(60) * torch.rand(count, dtype=torch.float64)
    return position, torch.stack([first, second], dim=-1), 0.5 + torch.rand(count, dtype=torch.float64)


@pytest.fixture
def corners() -> tuple[Tensor, Tensor, Tensor]:
    return random_corners(40)
