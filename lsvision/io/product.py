"""The product of a corrected scan: an OME-Zarr group of colour, height, validity and source.

Source: OME-NGFF 0.5 on Zarr 3. Each image has one level, its full resolution.
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
from zarr.codecs import ZstdCodec

from lsvision.errors import FileFormatError
from lsvision.io.atomic import partial_folder, replace_folder
from lsvision.io.bands import NUMPY_DTYPES, TORCH_DTYPES
from lsvision.io.tiff import ZSTD_LEVEL
from lsvision.io.validation import Fields

PRODUCT_FORMAT = "lsvision-product/1"
_ROOT_METADATA = "zarr.json"
_IMAGES = ("color", "height", "valid", "source")


@dataclass(frozen=True)
class ProductLayout:
    """What a product's images look like before anything is in them.

    ``shape`` is (rows, columns) of the grid, ``pitch_mm`` the side of its square cells, ``origin_mm`` the (q_y, q_x) of
    the centre of cell (0, 0); ``channels`` (1 or 3) and ``dtype`` (uint8 or uint16) are those of the colour image. A
    chunk holds ``chunk_rows`` rows and all columns. ``metadata`` is plain data kept with the product.
    """

    shape: tuple[int, int]
    pitch_mm: float
    origin_mm: tuple[float, float]
    channels: int
    dtype: torch.dtype
    chunk_rows: int
    metadata: Mapping[str, object]


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
            self._arrays: dict[str, Any] = {name: root[f"{name}/0"] for name in _IMAGES}
        except Exception as error:  # damaged metadata surfaces as any of a dozen types
            raise FileFormatError(folder, f"not a product to be written: {error}") from error

    def write(
        self,
        row: int,
        color: Tensor,
        height: Float[Tensor, "rows columns"],
        valid: Bool[Tensor, "rows columns"],
        source: Float[Tensor, "rows columns 2"],
    ) -> None:
        """Write a block of rows.

        Args:
            row: first row of the block.
            color: (rows, columns, channels) of the product's dtype.
            height: mm towards the cameras from the plane of zero disparity; NaN where invalid.
            valid: whether anything saw the cell.
            source: (line, column) of the scan that the cell came from; NaN where invalid.

        Raises:
            ValueError: a block of another shape or dtype, or outside the grid.
        """
        rows, (grid_rows, columns) = len(height), self._arrays["height"].shape
        if row < 0 or row + rows > grid_rows:
            raise ValueError(f"row: expected a block within 0..{grid_rows}, got {row}..{row + rows}")
        image = self._arrays["color"]
        _check("color", color, (rows, columns, image.shape[0]), TORCH_DTYPES[np.dtype(image.dtype)])
        _check("height", height, (rows, columns), torch.float32)
        _check("valid", valid, (rows, columns), torch.bool)
        _check("source", source, (rows, columns, 2), torch.float32)
        for name, block in (("height", height), ("valid", valid)):
            self._arrays[name][row : row + rows] = block.numpy(force=True)
        for name, block in (("color", color), ("source", source)):
            self._arrays[name][:, row : row + rows] = block.movedim(-1, 0).numpy(force=True)


def create_product(folder: Path | str, layout: ProductLayout) -> ProductRows:
    """Lay out an empty product, all of it invalid, in a folder that takes the product's name when it is complete."""
    attributes = {"lsvision": {**layout.metadata, "format": PRODUCT_FORMAT}}
    root = zarr.open_group(folder, mode="w", zarr_format=3, attributes=attributes)
    _create_image(root, layout, "color", NUMPY_DTYPES[layout.dtype], 0, layout.channels)
    _create_image(root, layout, "height", np.float32, np.nan)
    _create_image(root, layout, "valid", np.bool_, False)
    _create_image(root, layout, "source", np.float32, np.nan, 2)
    return ProductRows(folder)


def complete_product(folder: Path | str, target: Path | str) -> None:
    """Give a product whose rows are all written its final name; an earlier product there is replaced.

    Raises:
        FileFormatError: ``target`` holds something else.
    """
    replace_folder(folder, target, marker=_ROOT_METADATA)


class ProductWriter:
    """Context manager that writes a product by blocks of rows; it appears under its name when the block ends well.

    Rows lie along q_y, columns along q_x. Rows never written stay invalid. Blocks that are whole chunks are written
    fastest.

    Args:
        path: final folder (``<scan>.zarr``): new, empty, or an earlier product to replace.
        shape, pitch_mm, origin_mm, channels, dtype, chunk_rows, metadata: see ``ProductLayout``.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        shape: tuple[int, int],
        pitch_mm: float,
        origin_mm: tuple[float, float],
        channels: int,
        dtype: torch.dtype,
        chunk_rows: int,
        metadata: Mapping[str, object],
    ) -> None:
        self._path = Path(path)
        self._layout = ProductLayout(shape, pitch_mm, origin_mm, channels, dtype, chunk_rows, metadata)
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
    ) -> None:
        """Write a block of rows; arguments and errors as of ``ProductRows.write``."""
        if self._rows is None:
            raise ValueError("write: the writer is used as a context manager")
        self._rows.write(row, color, height, valid, source)


def _create_image(root: Any, layout: ProductLayout, name: str, dtype: Any, fill: object, channels: int = 0) -> None:
    axes = ("c", "y", "x") if channels else ("y", "x")
    leading = (channels,) if channels else ()
    group = root.create_group(name, attributes={"ome": _multiscales(name, axes, layout.pitch_mm, layout.origin_mm)})
    group.create_array(
        "0",
        shape=(*leading, *layout.shape),
        chunks=(*leading, min(layout.chunk_rows, layout.shape[0]), layout.shape[1]),
        dtype=dtype,
        fill_value=fill,
        compressors=[ZstdCodec(level=ZSTD_LEVEL)],
        dimension_names=axes,
    )


def _check(name: str, block: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    if tuple(block.shape) != shape or block.dtype != dtype:
        raise ValueError(f"{name}: expected {shape} {dtype}, got {tuple(block.shape)} {block.dtype}")


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

    def _read(self, name: str, start: int, stop: int) -> Tensor:
        if not 0 <= start <= stop <= self.shape[0]:
            raise ValueError(f"start, stop: expected a range within 0..{self.shape[0]}, got {start}..{stop}")
        array = zarr.open_array(self.path / name / "0", mode="r")
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
        rows, columns = root["height/0"].shape
        incomplete = [name for name in ("color", "valid", "source") if root[f"{name}/0"].shape[-2:] != (rows, columns)]
    except Exception as error:  # damaged metadata surfaces as any of a dozen types
        raise FileFormatError(path, f"not a readable product: {error}") from error
    metadata = dict(root.attrs.get("lsvision", {}))
    Fields(path, metadata, "lsvision.").choice("format", PRODUCT_FORMAT)
    if incomplete:
        raise FileFormatError(path, f"expected {rows} x {columns} cells as height has", incomplete[0])
    q_y, q_x = translation["translation"]
    return Product(path, (rows, columns), float(scale["scale"][-1]), (float(q_y), float(q_x)), metadata)


def _multiscales(name: str, axes: tuple[str, ...], pitch_mm: float, origin_mm: tuple[float, float]) -> dict:
    """NGFF metadata of one image; its levels are the entries of ``datasets``."""
    leading = len(axes) - 2
    return {
        "version": "0.5",
        "multiscales": [
            {
                "name": name,
                "axes": [_axis(axis) for axis in axes],
                "datasets": [
                    {
                        "path": "0",
                        "coordinateTransformations": [
                            {"type": "scale", "scale": [1.0] * leading + [pitch_mm, pitch_mm]},
                            {"type": "translation", "translation": [0.0] * leading + list(origin_mm)},
                        ],
                    }
                ],
            }
        ],
    }


def _axis(name: str) -> dict[str, str]:
    return {"name": name, "type": "channel"} if name == "c" else {"name": name, "type": "space", "unit": "millimeter"}
