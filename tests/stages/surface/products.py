"""Products in memory whose surface is known."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.types import ProductGrid

PITCH_MM, RADIUS_MM = 0.2, 60.0


@dataclass(frozen=True)
class MemoryProduct:
    """A product of given heights and colours."""

    heights: Tensor
    colors: Tensor
    sigmas: Tensor | None = None
    pitch_mm: float = PITCH_MM

    @property
    def grid(self) -> ProductGrid:
        return ProductGrid(*self.heights.shape, self.pitch_mm, 5.0, -self.pitch_mm * self.heights.shape[1] / 2)

    @property
    def has_sigma(self) -> bool:
        return self.sigmas is not None

    def color(self, start: int, stop: int) -> Tensor:
        return self.colors[start:stop]

    def height(self, start: int, stop: int) -> Tensor:
        return self.heights[start:stop]

    def sigma(self, start: int, stop: int) -> Tensor:
        assert self.sigmas is not None
        return self.sigmas[start:stop]


def places(rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """(q_y, q_x) of the cells of such a product, mm."""
    q_y = 5.0 + PITCH_MM * torch.arange(rows)[:, None].double()
    q_x = PITCH_MM * (torch.arange(columns).double() - columns / 2)
    return q_y, q_x


def rail(
    rows: int, *, columns: int = 300, seed: int = 0, noise_mm: float = 0.005, shaken_mm: float = 0.0
) -> MemoryProduct:
    """An arc of 60 mm radius, 48 mm wide, over ground that is 30 mm lower; rough, shaken and rolling if asked."""
    generator = torch.Generator().manual_seed(seed)
    q_y, q_x = places(rows, columns)
    wave = torch.sin(2 * torch.pi * q_y / 61.0)
    height = _arc(q_x - 0.5 * shaken_mm * wave) + shaken_mm * wave + 0.01 * shaken_mm * wave * q_x
    height = torch.where(q_x.abs() <= 24.0, height, -30.0)
    height = height + noise_mm * torch.randn(rows, columns, generator=generator, dtype=torch.float64)
    bright = 120 + 10 * torch.randn(rows, columns, 1, generator=generator)
    return MemoryProduct(height.float(), bright.clamp(0, 255).to(torch.uint8))


def dented(
    product: MemoryProduct, along_mm: float, across_mm: float, radius_mm: float, depth_mm: float
) -> MemoryProduct:
    """With a bowl, whose middle is ``depth_mm`` under the surface along its normal; a bump where that is below zero."""
    q_y, q_x = places(*product.heights.shape)
    around = RADIUS_MM * (torch.asin((q_x / RADIUS_MM).clamp(-1, 1)) - torch.asin(torch.tensor(across_mm / RADIUS_MM)))
    share = (1 - ((q_y - along_mm) ** 2 + around**2) / radius_mm**2).clamp(min=0).square()
    lower = depth_mm * share / torch.cos(torch.asin((q_x / RADIUS_MM).clamp(-0.9, 0.9)))
    return MemoryProduct((product.heights - lower).float(), product.colors, product.sigmas)


def _arc(x: Tensor) -> Tensor:
    return (RADIUS_MM**2 - x.square()).clamp(min=0).sqrt() - RADIUS_MM
