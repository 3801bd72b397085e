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
        FileFormatError: the product's metadata lack the datum of its heights. ConfigError: laspy is not installed.
    """
    if kind == "tiff":
        return _write_images(product, base)
    target = base.with_name(f"{base.name}.{kind}")
    write = write_ply if kind == "ply" else write_laz
    write(target, _points(product))
    return [target]


def _write_images(product: Product, base: Path) -> list[Path]:
    rows, columns = product.shape
    starts = range(0, rows, _ROWS)
    first = product.color(0, min(1, rows))
    files = [base.with_name(f"{base.name}_{name}.tif") for name in ("color", "height")]
    colors = (product.color(row, min(row + _ROWS, rows)) for row in starts)
    write_line_image(files[0], colors, (rows, columns, first.shape[2]), first.dtype)
    heights = (product.height(row, min(row + _ROWS, rows))[..., None] for row in starts)
    write_line_image(files[1], heights, (rows, columns, 1), torch.float32)
    return files


def _points(product: Product) -> Iterator[tuple[Tensor, Tensor]]:
    """Points, mm, and their colours of eight bits, some rows at a time."""
    # Products of version 0.1 count heights from the depth of zero disparity itself.
    datum_mm = product.metadata.get("height_datum_mm", product.metadata.get("zero_disparity_mm"))
    if not isinstance(datum_mm, float):
        raise FileFormatError(product.path, f"expected a number, got {datum_mm!r}", "lsvision.height_datum_mm")
    (origin_y, origin_x), (rows, columns) = product.origin_mm, product.shape
    q_x = origin_x + product.pitch_mm * torch.arange(columns, dtype=torch.float64)
    for row in range(0, rows, _ROWS):
        stop = min(row + _ROWS, rows)
        height, valid, color = product.height(row, stop), product.valid(row, stop), product.color(row, stop)
        q_y = origin_y + product.pitch_mm * torch.arange(row, stop, dtype=torch.float64)
        places = torch.stack(
            [q_x.expand(valid.shape), q_y[:, None].expand(valid.shape), datum_mm - height.double()], dim=-1
        )
        if color.dtype == torch.uint16:
            color = (color.to(torch.int32) // 257).to(torch.uint8)
        yield places[valid], color.expand(*valid.shape, 3)[valid]
