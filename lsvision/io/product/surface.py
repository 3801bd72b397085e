"""The unrolled surface of a product: its group ``surface``, images by arc length across and by place along.

``color``, ``deviation`` (mm, float32, NaN where not measured) and its ``sigma``, each a pyramid as a product's images
are; beside them the tables of the candidates.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.atomic import partial_folder
from lsvision.io.images.bands import NUMPY_DTYPES
from lsvision.io.json_file import finite_or_null
from lsvision.io.product.layout import FULL_LEVEL, ROOT_METADATA, ProductLayout, create_image
from lsvision.io.product.reader import Product
from lsvision.io.product.writer import open_levels, write_levels
from lsvision.types import ProductGrid

SURFACE_FORMAT = "lsvision-surface/1"
SURFACE_GROUP = "surface"
_IMAGES = ("color", "deviation", "sigma")


class SurfaceRows:
    """The images of a surface that is being written; ``folder`` is where its tables go."""

    def __init__(self, folder: Path, layout: ProductLayout) -> None:
        attributes = {"lsvision": finite_or_null({**layout.metadata, "format": SURFACE_FORMAT})}
        root = zarr.open_group(folder, mode="w", zarr_format=3, attributes=attributes)
        create_image(root, layout, "color", NUMPY_DTYPES[layout.dtype], 0, layout.channels)
        for name in ("deviation", "sigma"):
            create_image(root, layout, name, np.float32, np.nan)
        self.folder = folder
        self._levels = {name: open_levels(root[name]) for name in _IMAGES}

    def write(
        self,
        row: int,
        color: Shaped[Tensor, "rows cells channels"],
        deviation: Float[Tensor, "rows cells"],
        sigma: Float[Tensor, "rows cells"],
    ) -> None:
        """Write rows of every image, at every level of the pyramid; strips are whole chunks."""
        for name, block in zip(_IMAGES, (color, deviation, sigma), strict=True):
            write_levels(self._levels[name], row, block, average=name == "color")


@contextmanager
def surface_writer(
    product: Product, grid: ProductGrid, chunk_rows: int, metadata: Mapping[str, Any]
) -> Iterator[SurfaceRows]:
    """Write the surface of a product, in which it appears when the block ends without an error; an earlier one goes.

    Args:
        grid: of the unrolled images, whose columns are arc lengths.

    Raises:
        WriteError: the disk is full.
    """
    color = product.color(0, 0)
    layout = ProductLayout(grid, color.shape[2], color.dtype, chunk_rows, metadata)
    with partial_folder(product.path / SURFACE_GROUP, marker=ROOT_METADATA) as folder:
        yield SurfaceRows(folder, layout)


def write_no_surface(product: Product, problem: str, key: str) -> None:
    """Say in a product why it has no surface, in place of an earlier one."""
    with partial_folder(product.path / SURFACE_GROUP, marker=ROOT_METADATA) as folder:
        attributes = {"lsvision": {"format": SURFACE_FORMAT, "problem": problem, "key": key}}
        zarr.open_group(folder, mode="w", zarr_format=3, attributes=attributes)


def surface_metadata(product: Path | str) -> dict[str, Any]:
    """What the surface of the product at a path says about itself; empty where it has none that can be read."""
    try:
        return dict(zarr.open_group(Path(product) / SURFACE_GROUP, mode="r").attrs["lsvision"])
    except Exception:  # damaged metadata surfaces as any of a dozen types
        return {}


@dataclass(frozen=True)
class Surface:
    """The surface of a product on disk; images are read by ranges of rows."""

    path: Path
    grid: ProductGrid
    metadata: Mapping[str, Any]

    def color(self, start: int, stop: int, level: int = 0) -> Shaped[Tensor, "rows cells channels"]:
        """Colours of rows of a level of the pyramid."""
        return self._read("color", start, stop, level).movedim(0, -1).contiguous()

    def deviation(self, start: int, stop: int, level: int = 0) -> Float[Tensor, "rows cells"]:
        """Distance from the profile along its normal, mm; NaN where not measured."""
        return self._read("deviation", start, stop, level)

    def sigma(self, start: int, stop: int, level: int = 0) -> Float[Tensor, "rows cells"]:
        """Standard deviation of the deviation, mm."""
        return self._read("sigma", start, stop, level)

    def levels(self) -> int:
        """Of the pyramid."""
        return len(list(zarr.open_group(self.path / "deviation", mode="r").array_keys()))

    def _read(self, name: str, start: int, stop: int, level: int) -> Tensor:
        array = zarr.open_array(self.path / name / str(level), mode="r")
        return torch.from_numpy(np.ascontiguousarray(np.asarray(array[..., start:stop, :])))


def read_surface(product: Product) -> Surface:
    """Open the surface of a product.

    Raises:
        FileFormatError: it was not inspected, or the surface is damaged.
    """
    path = product.path / SURFACE_GROUP
    if not path.is_dir():
        raise FileFormatError(product.path, "holds no surface: inspect it first")
    if problem := surface_metadata(product.path).get("problem"):
        raise FileFormatError(product.path, str(problem))
    try:
        root = zarr.open_group(path, mode="r")
        metadata = dict(root.attrs["lsvision"])
        scale, translation = root["deviation"].attrs["ome"]["multiscales"][0]["datasets"][0][
            "coordinateTransformations"
        ]
        rows, cells = root[f"deviation/{FULL_LEVEL}"].shape
        grid = ProductGrid(rows, cells, float(scale["scale"][-1]), *map(float, translation["translation"]))
    except Exception as error:  # damaged metadata surfaces as any of a dozen types
        raise FileFormatError(path, f"not a readable surface: {' '.join(str(error).split())}") from error
    if metadata.get("format") != SURFACE_FORMAT:
        raise FileFormatError(path, f"expected {SURFACE_FORMAT!r}", "lsvision.format")
    return Surface(path, grid, metadata)
