"""The layout of a product: an OME-Zarr group of images, each a pyramid over the same grid of cells.

``color``, ``height``, ``valid`` and ``source``, and ``sigma`` where it was asked for; beside them the group
``line_motion`` where that was corrected. A chunk holds the rows of a strip
over all columns, at every level of the pyramid, so that strips never share a chunk; each chunk carries a checksum that
every reader verifies.

Source: OME-NGFF 0.5 on Zarr 3.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from torch import Tensor
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

from lsvision.io.images.bands import NUMPY_DTYPES
from lsvision.io.images.tiff import ZSTD_LEVEL
from lsvision.io.json_file import finite_or_null
from lsvision.io.product.line_motion import create_line_motion
from lsvision.io.product.pyramid import level_count, level_shape, multiscales
from lsvision.types import LineMotion, ProductGrid, ProductStrip

PRODUCT_FORMAT = "lsvision-product/1"
ROOT_METADATA = "zarr.json"
FULL_LEVEL = "0"  # of an image's pyramid

_COLOR_CODECS = (ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec())
# Neighbouring floats share their leading bytes: sorted by byte they are a third smaller, and packed twice as fast.
_PLANE_CODECS = (BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec())


@dataclass(frozen=True)
class ProductLayout:
    """What a product's images look like before anything is in them.

    ``channels`` (1 or 3) and ``dtype`` (uint8 or uint16) are those of the colour image. A chunk holds ``chunk_rows``
    rows and all columns. ``metadata`` is plain data kept with the product. With ``uncertainty`` the product also holds
    the standard deviations of its positions. ``source_dtype`` is that of the positions in the scan.
    ``line_motion`` is what the scan was corrected for besides n.
    """

    grid: ProductGrid
    channels: int
    dtype: torch.dtype
    chunk_rows: int
    metadata: Mapping[str, object]
    uncertainty: bool = False
    source_dtype: torch.dtype = torch.float32
    line_motion: LineMotion | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) at full resolution."""
        return self.grid.rows, self.grid.columns

    @property
    def levels(self) -> int:
        """Levels of the pyramid, full resolution included."""
        return level_count(self.shape, self.chunk_rows)


def create_images(folder: Path | str, layout: ProductLayout) -> None:
    """Create a product's groups and arrays, every cell invalid."""
    attributes = {"lsvision": finite_or_null({**layout.metadata, "format": PRODUCT_FORMAT})}
    root = zarr.open_group(folder, mode="w", zarr_format=3, attributes=attributes)
    create_image(root, layout, "color", NUMPY_DTYPES[layout.dtype], 0, layout.channels)
    create_image(root, layout, "height", np.float32, np.nan)
    create_image(root, layout, "valid", np.bool_, False)
    source = np.float64 if layout.source_dtype == torch.float64 else np.float32
    create_image(root, layout, "source", source, np.nan, 2)
    if layout.uncertainty:
        create_image(root, layout, "sigma", np.float32, np.nan, 3)
    if layout.line_motion is not None:
        create_line_motion(root, layout.line_motion)


def image_names(root: Any) -> list[str]:
    """Names of the images of an open product."""
    return ["color", "height", "valid", "source", *(["sigma"] if "sigma" in root else [])]


def strip_images(strip: ProductStrip) -> dict[str, Tensor]:
    """A strip's rows of every image, by name."""
    images = {"color": strip.color, "height": strip.height, "valid": strip.valid, "source": strip.source}
    return images if strip.sigma is None else {**images, "sigma": strip.sigma}


def create_image(root: Any, layout: ProductLayout, name: str, dtype: Any, fill: object, channels: int = 0) -> None:
    """Create one image with its pyramid, every cell ``fill``, in an open group."""
    axes = ("c", "y", "x") if channels else ("y", "x")
    leading = (channels,) if channels else ()
    ome = multiscales(name, axes, layout.grid, layout.levels, averaged=name == "color")
    group = root.create_group(name, attributes={"ome": ome})
    for level in range(layout.levels):
        rows, columns = level_shape(layout.shape, level)
        group.create_array(
            str(level),
            shape=(*leading, rows, columns),
            chunks=(*leading, min(layout.chunk_rows >> level, rows), columns),
            dtype=dtype,
            fill_value=fill,
            compressors=_COLOR_CODECS if name == "color" else _PLANE_CODECS,
            dimension_names=axes,
        )
