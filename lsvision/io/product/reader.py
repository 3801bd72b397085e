"""The product of a corrected scan: an OME-Zarr group of colour, height, validity and source, opened for reading.

Source: OME-NGFF 0.5 on Zarr 3.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.schema import shown

PRODUCT_FORMAT = "lsvision-product/1"
FULL_LEVEL = "0"  # of an image's pyramid


def image_names(root: Any) -> list[str]:
    """The images of an open product: these four, and ``sigma`` where it was asked for."""
    return ["color", "height", "valid", "source", *(["sigma"] if "sigma" in root else [])]


@dataclass(frozen=True)
class Product:
    """A product on disk: its grid and metadata; the images are read by ranges of rows.

    ``shape`` is (rows, columns), ``origin_mm`` the (q_y, q_x) of the centre of cell (0, 0).
    """

    path: Path
    shape: tuple[int, int]
    pitch_mm: float
    origin_mm: tuple[float, float]
    metadata: Mapping[str, object]

    def color(self, start: int, stop: int) -> Tensor:
        """Colours of rows ``start..stop-1``, (rows, columns, channels)."""
        return self._read("color", start, stop)

    def height(self, start: int, stop: int) -> Float[Tensor, "rows columns"]:
        """Heights, mm, of rows ``start..stop-1``; NaN where invalid."""
        return self._read("height", start, stop)

    def valid(self, start: int, stop: int) -> Bool[Tensor, "rows columns"]:
        """Whether cells of rows ``start..stop-1`` were seen."""
        return self._read("valid", start, stop)

    def source(self, start: int, stop: int) -> Float[Tensor, "rows columns 2"]:
        """(line, column) of the scan that cells of rows ``start..stop-1`` came from; NaN where invalid."""
        return self._read("source", start, stop)

    def sigma(self, start: int, stop: int) -> Float[Tensor, "rows columns 3"]:
        """Standard deviations of (q_x, q_y, q_z), mm, of rows ``start..stop-1``; of products made with uncertainty."""
        return self._read("sigma", start, stop)

    @property
    def has_sigma(self) -> bool:
        """Whether the product says how well its positions are known."""
        return (self.path / "sigma").is_dir()

    def _read(self, name: str, start: int, stop: int) -> Tensor:
        if not 0 <= start <= stop <= self.shape[0]:
            raise ValueError(f"start, stop: expected a range within 0..{self.shape[0]}, got {start}..{stop}")
        array = zarr.open_array(self.path / name / FULL_LEVEL, mode="r")
        block = np.asarray(array[..., start:stop, :])
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(block, 0, -1) if block.ndim == 3 else block))


def read_product(path: Path | str) -> Product:
    """Open a product.

    Raises:
        FileFormatError: there is none, or it is of another kind or incomplete.
    """
    path = Path(path)
    try:
        root = zarr.open_group(path, mode="r")
        ome = root["height"].attrs["ome"]
        scale, translation = ome["multiscales"][0]["datasets"][0]["coordinateTransformations"]
        shapes = {name: root[f"{name}/{FULL_LEVEL}"].shape[-2:] for name in image_names(root)}
    except Exception as error:  # damaged metadata surfaces as any of a dozen types
        raise FileFormatError(path, f"not a readable product: {error}") from error
    metadata = dict(root.attrs.get("lsvision", {}))
    if metadata.get("format") != PRODUCT_FORMAT:
        problem = f"expected {PRODUCT_FORMAT!r}, got {shown(metadata.get('format'))}"
        raise FileFormatError(path, problem, "lsvision.format")
    rows, columns = shapes["height"]
    for name, shape in shapes.items():
        if shape != (rows, columns):
            raise FileFormatError(path, f"expected {rows} x {columns} cells as height has", name)
    q_y, q_x = translation["translation"]
    return Product(path, (rows, columns), float(scale["scale"][-1]), (float(q_y), float(q_x)), metadata)
