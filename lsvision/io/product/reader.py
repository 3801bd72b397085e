"""The product of a corrected scan, opened for reading."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import zarr
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.images.chunk_size import check_chunks
from lsvision.io.product.layout import FULL_LEVEL, PRODUCT_FORMAT, image_names
from lsvision.io.product.line_motion import read_columns
from lsvision.schema import shown
from lsvision.types import ProductGrid, ProductStrip

ImageName = Literal["color", "height", "valid", "source", "sigma"]


@dataclass(frozen=True)
class Product:
    """A product on disk: its grid and metadata; the images are read by ranges of rows."""

    path: Path
    grid: ProductGrid
    metadata: Mapping[str, object]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.grid.rows, self.grid.columns

    @property
    def pitch_mm(self) -> float:
        """Side of a cell, mm."""
        return self.grid.pitch_mm

    @property
    def origin_mm(self) -> tuple[float, float]:
        """(q_y, q_x) of the centre of cell (0, 0), mm."""
        return self.grid.origin_y_mm, self.grid.origin_x_mm

    @property
    def has_sigma(self) -> bool:
        """Whether the product holds the standard deviations of its positions."""
        return (self.path / "sigma").is_dir()

    @property
    def line_motion_metadata(self) -> Mapping[str, Any]:
        """What the product says about the motion from line to line; empty where it says nothing."""
        entry = self.metadata.get("line_motion")
        return entry if isinstance(entry, Mapping) else {}

    @property
    def has_line_motion(self) -> bool:
        """Whether the product says that a motion from line to line was looked for or given."""
        return str(self.line_motion_metadata.get("source", "none")) != "none"

    def line_motion(self) -> dict[str, Float[Tensor, " lines"]]:
        """Motion from line to line by name (``dx_mm``, ``dx_sigma_mm``, ..), of products that were corrected for it."""
        return read_columns(zarr.open_group(self.path, mode="r"))

    def read(self, start: int, stop: int) -> ProductStrip:
        """Rows ``start..stop-1`` of every image."""
        return ProductStrip(
            row=start,
            color=self.color(start, stop),
            height=self.height(start, stop),
            valid=self.valid(start, stop),
            source=self.source(start, stop),
            sigma=self.sigma(start, stop) if self.has_sigma else None,
        )

    def color(self, start: int, stop: int) -> Tensor:
        """Colours of rows ``start..stop-1``, (rows, columns, channels)."""
        return self._read("color", start, stop)

    def height(self, start: int, stop: int) -> Float[Tensor, "rows columns"]:
        """Heights, mm, of rows ``start..stop-1``; NaN where invalid."""
        return self._read("height", start, stop)

    def valid(self, start: int, stop: int) -> Bool[Tensor, "rows columns"]:
        """Whether cells of rows ``start..stop-1`` were measured."""
        return self._read("valid", start, stop)

    def source(self, start: int, stop: int) -> Float[Tensor, "rows columns 2"]:
        """(line, column) of the scan that cells of rows ``start..stop-1`` came from; NaN where nothing was seen."""
        return self._read("source", start, stop)

    def sigma(self, start: int, stop: int) -> Float[Tensor, "rows columns 3"]:
        """Standard deviations of (q_x, q_y, q_z), mm, of rows ``start..stop-1``; of products made with uncertainty."""
        return self._read("sigma", start, stop)

    def _read(self, name: str, start: int, stop: int) -> Tensor:
        if not 0 <= start <= stop <= self.grid.rows:
            raise ValueError(f"start, stop: expected a range within 0..{self.grid.rows}, got {start}..{stop}")
        array = zarr.open_array(self.path / name / FULL_LEVEL, mode="r")
        check_chunks(self.path / name / FULL_LEVEL, array, array.ndim - 2, (start, stop))
        block = np.asarray(array[..., start:stop, :])
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(block, 0, -1) if block.ndim == 3 else block))


@dataclass(frozen=True)
class ProductImage:
    """One image of a product, as a ``LineImage``."""

    product: Product
    name: ImageName

    @property
    def shape(self) -> tuple[int, int, int]:
        """(rows, columns, channels)."""
        return *self.product.shape, self.read(0, 0).shape[2]

    @property
    def dtype(self) -> torch.dtype:
        """That of the image."""
        return self.read(0, 0).dtype

    def read(self, start: int, stop: int) -> Tensor:
        """Rows ``start..stop-1``."""
        block: Tensor = getattr(self.product, self.name)(start, stop)
        return block if block.ndim == 3 else block[..., None]


def read_product(path: Path | str) -> Product:
    """Open a product.

    Raises:
        FileFormatError: there is no product, or it is of another kind or incomplete.
    """
    path = Path(path)
    try:
        root = zarr.open_group(path, mode="r")
        ome = root["height"].attrs["ome"]
        scale, translation = ome["multiscales"][0]["datasets"][0]["coordinateTransformations"]
        origin_y, origin_x = map(float, translation["translation"])
        pitch = float(scale["scale"][-1])
        metadata = dict(root.attrs.get("lsvision", {}))
        shapes = {name: root[f"{name}/{FULL_LEVEL}"].shape[-2:] for name in image_names(root)}
    except Exception as error:  # damaged metadata surfaces as any of a dozen types
        raise FileFormatError(path, f"not a readable product: {' '.join(str(error).split())}") from error
    if metadata.get("format") != PRODUCT_FORMAT:
        problem = f"expected {PRODUCT_FORMAT!r}, got {shown(metadata.get('format'))}"
        raise FileFormatError(path, problem, "lsvision.format")
    rows, columns = shapes["height"]
    for name, shape in shapes.items():
        if shape != (rows, columns):
            raise FileFormatError(path, f"expected {rows} x {columns} cells as height has", name)
    if not (0 < pitch < math.inf and math.isfinite(origin_y) and math.isfinite(origin_x)):
        problem = f"expected a finite pitch > 0 and origin, got {pitch} and {origin_y}, {origin_x}"
        raise FileFormatError(path, problem, "height.ome")
    return Product(path, ProductGrid(rows, columns, pitch, origin_y, origin_x), metadata)
