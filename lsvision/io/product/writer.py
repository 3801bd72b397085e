"""Writing a product: laid out once, its rows written in any order and by any number of processes.

Source: OME-NGFF 0.5 on Zarr 3. A chunk holds the rows of a strip over all columns, at every level of the pyramid, so
that strips never share a chunk; each carries a checksum that every reader verifies.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
import zarr
from jaxtyping import Bool, Float
from torch import Tensor
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

from lsvision.errors import FileFormatError
from lsvision.image.tiling import in_parallel
from lsvision.io.atomic import partial_folder, replace_folder
from lsvision.io.images.bands import NUMPY_DTYPES, TORCH_DTYPES
from lsvision.io.images.tiff import ZSTD_LEVEL
from lsvision.io.json_file import finite_or_null
from lsvision.io.product.pyramid import halve, level_count, level_shape, multiscales
from lsvision.io.product.reader import PRODUCT_FORMAT, image_names

_ROOT_METADATA = "zarr.json"
_COLOR_CODECS = (ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec())
# Neighbouring floats share their leading bytes: sorted by byte they are a third smaller, and packed twice as fast.
_PLANE_CODECS = (BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec())


@dataclass(frozen=True)
class ProductLayout:
    """What a product's images look like before anything is in them.

    ``shape`` is (rows, columns) of the grid, ``pitch_mm`` the side of its square cells, ``origin_mm`` the (q_y, q_x) of
    the centre of cell (0, 0); ``channels`` (1 or 3) and ``dtype`` (uint8 or uint16) are those of the colour image. A
    chunk holds ``chunk_rows`` rows and all columns. ``metadata`` is plain data kept with the product. With
    ``uncertainty`` the product also holds the standard deviations of its positions.
    """

    shape: tuple[int, int]
    pitch_mm: float
    origin_mm: tuple[float, float]
    channels: int
    dtype: torch.dtype
    chunk_rows: int
    metadata: Mapping[str, object]
    uncertainty: bool = False

    @property
    def levels(self) -> int:
        """Levels of the pyramid, full resolution included."""
        return level_count(self.shape, self.chunk_rows)


class ProductRows:
    """The images of a product that is being written, in a folder that is not its final one.

    Several processes may each write rows of their own at once as long as no two share a chunk.

    Args:
        folder: what ``create_product`` made.

    Raises:
        FileFormatError: the folder holds no product.
    """

    def __init__(self, folder: Path | str) -> None:
        try:
            root = zarr.open_group(folder, mode="r+")
            # An empty chunk is written too: one that is missing is then always one that was lost.
            self._levels: dict[str, list[Any]] = {
                name: [level.with_config({"write_empty_chunks": True}) for _, level in sorted(root[name].arrays())]
                for name in image_names(root)
            }
        except Exception as error:  # damaged metadata surfaces as any of a dozen types
            raise FileFormatError(folder, f"not a product to be written: {error}") from error

    def write(
        self,
        row: int,
        color: Tensor,
        height: Float[Tensor, "rows columns"],
        valid: Bool[Tensor, "rows columns"],
        source: Float[Tensor, "rows columns 2"],
        sigma: Float[Tensor, "rows columns 3"] | None = None,
    ) -> None:
        """Write a block of rows.

        Args:
            row: first row of the block.
            color: (rows, columns, channels) of the product's dtype.
            height: mm towards the cameras from the plane of zero disparity; NaN where invalid.
            valid: whether anything saw the cell.
            source: (line, column) of the scan that the cell came from; NaN where invalid.
            sigma: standard deviations of (q_x, q_y, q_z), mm, for a product with uncertainty.

        Raises:
            ValueError: a block of another shape or dtype, outside the grid, or that splits cells of the pyramid.
        """
        rows, (grid_rows, columns) = len(height), self._levels["height"][0].shape
        if row < 0 or row + rows > grid_rows:
            raise ValueError(f"row: expected a block within 0..{grid_rows}, got {row}..{row + rows}")
        coarsest = 2 ** (len(self._levels["height"]) - 1)
        if row % coarsest or (row + rows != grid_rows and rows % coarsest):
            raise ValueError(f"row: expected blocks of whole groups of {coarsest} rows, got {row}..{row + rows}")
        image = self._levels["color"][0]
        _check("color", color, (rows, columns, image.shape[0]), TORCH_DTYPES[np.dtype(image.dtype)])
        _check("height", height, (rows, columns), torch.float32)
        _check("valid", valid, (rows, columns), torch.bool)
        _check("source", source, (rows, columns, 2), torch.float32)
        if (sigma is not None) != ("sigma" in self._levels):
            raise ValueError(f"sigma: the product {'has none' if sigma is not None else 'needs it'}")
        blocks = {"color": color, "height": height, "valid": valid, "source": source}
        if sigma is not None:
            _check("sigma", sigma, (rows, columns, 3), torch.float32)
            blocks["sigma"] = sigma
        in_parallel(lambda name: self._write_levels(name, row, blocks[name]), blocks)

    def _write_levels(self, name: str, row: int, block: Tensor) -> None:
        for index, level in enumerate(self._levels[name]):
            first = row >> index
            if block.ndim == 3:
                level[:, first : first + len(block)] = block.movedim(-1, 0).numpy(force=True)
            else:
                level[first : first + len(block)] = block.numpy(force=True)
            if index + 1 < len(self._levels[name]):
                block = halve(block, average=name == "color")


def create_product(folder: Path | str, layout: ProductLayout) -> ProductRows:
    """Lay out an empty product, all of it invalid, in a folder that takes the product's name when it is complete."""
    attributes = {"lsvision": finite_or_null({**layout.metadata, "format": PRODUCT_FORMAT})}
    root = zarr.open_group(folder, mode="w", zarr_format=3, attributes=attributes)
    _create_image(root, layout, "color", NUMPY_DTYPES[layout.dtype], 0, layout.channels)
    _create_image(root, layout, "height", np.float32, np.nan)
    _create_image(root, layout, "valid", np.bool_, False)
    _create_image(root, layout, "source", np.float32, np.nan, 2)
    if layout.uncertainty:
        _create_image(root, layout, "sigma", np.float32, np.nan, 3)
    return ProductRows(folder)


def complete_product(folder: Path | str, target: Path | str) -> None:
    """Give a product whose rows are all written its final name; an earlier product there is replaced.

    Raises:
        FileFormatError: ``target`` holds something else.
    """
    replace_folder(folder, target, marker=_ROOT_METADATA)


class ProductWriter:
    """Context manager that writes a product by blocks of rows; it appears under its name when the block ends well.

    Rows lie along q_y, columns along q_x. Blocks that are whole chunks are written fastest.

    Args:
        path: final folder (``<scan>.zarr``): new, empty, or an earlier product to replace.
    """

    def __init__(self, path: Path | str, layout: ProductLayout) -> None:
        self._path, self._layout = Path(path), layout
        self._stack = ExitStack()
        self._rows: ProductRows | None = None

    def __enter__(self) -> "ProductWriter":
        with ExitStack() as stack:
            folder = stack.enter_context(partial_folder(self._path, marker=_ROOT_METADATA))
            self._rows = create_product(folder, self._layout)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return self._stack.__exit__(kind, error, trace)

    def write(
        self,
        row: int,
        color: Tensor,
        height: Float[Tensor, "rows columns"],
        valid: Bool[Tensor, "rows columns"],
        source: Float[Tensor, "rows columns 2"],
        sigma: Float[Tensor, "rows columns 3"] | None = None,
    ) -> None:
        """Write a block of rows; arguments and errors as of ``ProductRows.write``."""
        if self._rows is None:
            raise ValueError("write: the writer is used as a context manager")
        self._rows.write(row, color, height, valid, source, sigma)


def _create_image(root: Any, layout: ProductLayout, name: str, dtype: Any, fill: object, channels: int = 0) -> None:
    axes = ("c", "y", "x") if channels else ("y", "x")
    leading = (channels,) if channels else ()
    ome = multiscales(name, axes, layout.pitch_mm, layout.origin_mm, layout.levels, averaged=name == "color")
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


def _check(name: str, block: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    if tuple(block.shape) != shape or block.dtype != dtype:
        raise ValueError(f"{name}: expected {shape} {dtype}, got {tuple(block.shape)} {block.dtype}")
