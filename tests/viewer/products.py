"""A small product with a surface, on disk."""

from pathlib import Path

import torch

from lsvision.archive.inspection import inspect_product
from lsvision.io import ProductLayout, product_writer, read_product
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import ProductStrip
from tests.stages.surface.products import dented, rail


def write_rail(path: Path, *, inspected: bool = True) -> Path:
    """1200 x 600 cells of a rail with a dent, in three levels, whose colours differ from cell to cell."""
    memory = dented(rail(1200, columns=600), 50.0, 0.0, 3.0, 0.3)
    color = (torch.arange(1200)[:, None, None] + 3 * torch.arange(600)[:, None] + torch.tensor([0, 60, 120])) % 256
    layout = ProductLayout(memory.grid, 3, torch.uint8, 512, {"scan": "rail"})
    with product_writer(path, layout) as rows:
        for start in (0, 512, 1024):
            part = slice(start, start + 512)
            height = memory.heights[part]
            source = torch.zeros(*height.shape, 2)
            rows.write(ProductStrip(start, color[part].to(torch.uint8), height, height.isfinite(), source))
    if inspected:
        inspect_product(read_product(path), SurfaceConfig(smoothing_mm=0.6))
    return path
