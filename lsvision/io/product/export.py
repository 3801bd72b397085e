"""Products for other programs: BigTIFF images, and point clouds as PLY and LAZ."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.images.tiff import write_line_image
from lsvision.io.product.las import write_laz
from lsvision.io.product.ply import write_ply
from lsvision.io.product.reader import Product

ExportFormat = Literal["tiff", "ply", "laz"]

_ROWS = 256  # read at once


def export_product(product: Product, kind: ExportFormat, base: Path) -> list[Path]:
    """Write a product as ``<base>_color.tif`` and ``<base>_height.tif``, as ``<base>.ply`` or as ``<base>.laz``.

    Points are the valid cells as (q_x, q_y, q_z) of the product frame, mm. Heights are float32 mm, NaN where invalid.

    Returns:
        The files written.

    Raises:
        FileFormatError: the product's metadata lack the datum of its heights.
        ConfigError: laspy is not installed.
    """
    if kind == "tiff":
        return _write_images(product, base)
    target = base.with_name(f"{base.name}.{kind}")
    write = write_ply if kind == "ply" else write_laz
    write(target, _points(product))
    return [target]


def _write_images(product: Product, base: Path) -> list[Path]:
    rows, columns = product.shape
    ranges = [(row, min(row + _ROWS, rows)) for row in range(0, rows, _ROWS)]
    color_file, height_file = (base.with_name(f"{base.name}_{name}.tif") for name in ("color", "height"))
    first = product.color(0, min(1, rows))
    colors = (product.color(start, stop) for start, stop in ranges)
    write_line_image(color_file, colors, (rows, columns, first.shape[2]), first.dtype)
    heights = (product.height(start, stop)[..., None] for start, stop in ranges)
    write_line_image(height_file, heights, (rows, columns, 1), torch.float32)
    return [color_file, height_file]


def _points(product: Product) -> Iterator[tuple[Tensor, Tensor]]:
    """Points, mm, and their colours of eight bits, some rows at a time."""
    datum, grid = height_datum(product), product.grid
    q_x = grid.origin_x_mm + grid.pitch_mm * torch.arange(grid.columns, dtype=torch.float64)
    for row in range(0, grid.rows, _ROWS):
        stop = min(row + _ROWS, grid.rows)
        height, valid, color = product.height(row, stop), product.valid(row, stop), product.color(row, stop)
        q_y = grid.origin_y_mm + grid.pitch_mm * torch.arange(row, stop, dtype=torch.float64)
        q_z = datum - height.double()
        points = torch.stack([q_x.expand(valid.shape), q_y[:, None].expand(valid.shape), q_z], dim=-1)
        if color.dtype == torch.uint16:
            color = (color.to(torch.int32) // 257).to(torch.uint8)
        yield points[valid], color.expand(*valid.shape, 3)[valid]


def height_datum(product: Product) -> float:
    """q_z of height zero, mm; products of version 0.1 count heights from the depth of zero disparity itself.

    Raises:
        FileFormatError: the metadata give neither.
    """
    datum = product.metadata.get("height_datum_mm", product.metadata.get("zero_disparity_mm"))
    if not isinstance(datum, float):
        raise FileFormatError(product.path, f"expected a number, got {datum!r}", "lsvision.height_datum_mm")
    return datum
