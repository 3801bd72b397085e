"""Re-reading a product: every chunk against its checksum, and the images against each other."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import zarr

from lsvision.errors import FileFormatError, LsvisionError
from lsvision.io.images.chunk_size import check_chunk_count, check_chunks
from lsvision.io.product.layout import image_names
from lsvision.io.product.line_motion import check_line_motion
from lsvision.io.product.measured import MeasuredCells
from lsvision.io.product.pyramid import level_shape, multiscales
from lsvision.io.product.reader import Product, read_product


@dataclass(frozen=True)
class ProductCheck:
    """What a whole product holds: its cells, the share of them with a height, and the range of those heights."""

    rows: int
    columns: int
    levels: int
    valid_share: float
    lowest_mm: float
    highest_mm: float


def check_product(path: Path | str) -> ProductCheck:
    """Read a product from end to end.

    Raises:
        FileFormatError: metadata that are not those of NGFF 0.5 or do not fit the images, a chunk that is missing or
            damaged, or images that contradict each other; names the image and the rows.
    """
    product = read_product(path)
    try:
        return _check(product)
    except LsvisionError:
        raise
    except Exception as error:  # damaged metadata surfaces as any of a dozen types
        problem = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileFormatError(product.path, f"damaged: {problem}") from error


def _check(product: Product) -> ProductCheck:
    root = zarr.open_group(product.path, mode="r")
    for name in image_names(root):
        levels = _check_metadata(product, name, root[name])
        for level in range(levels):
            _check_level(product, f"{name}/{level}", root[f"{name}/{level}"], level_shape(product.shape, level))
    check_line_motion(product.path, root, product.has_line_motion)
    measured = _check_cells(product, chunk_rows=root["height/0"].chunks[0])
    rows, columns = product.shape
    share = measured.count / (rows * columns)
    return ProductCheck(rows, columns, levels, share, measured.lowest_mm, measured.highest_mm)


def _check_metadata(product: Product, name: str, group: Any) -> int:
    """Number of levels of an image whose metadata describe them."""
    levels = sorted(int(level) for level in group.array_keys())
    axes = ("c", "y", "x") if group["0"].ndim == 3 else ("y", "x")
    expected = multiscales(name, axes, product.grid, len(levels), averaged=name == "color")
    if levels != list(range(len(levels))) or group.attrs.get("ome") != expected:
        problem = "the metadata do not describe the image and its pyramid in NGFF 0.5"
        raise FileFormatError(product.path, problem, f"{name}.ome")
    return len(levels)


def _check_level(product: Product, key: str, array: Any, shape: tuple[int, int]) -> None:
    """Shape and checksums of one level; a chunk whose checksum fails cannot be read."""
    if array.shape[-2:] != shape:
        raise FileFormatError(product.path, f"expected {shape[0]} x {shape[1]} cells, got {array.shape}", key)
    check_chunk_count(product.path / key, array)
    if array.nchunks_initialized != array.nchunks:
        missing = array.nchunks - array.nchunks_initialized
        raise FileFormatError(product.path, f"{missing} of {array.nchunks} chunks are missing", key)
    step = array.chunks[-2]
    for row in range(0, shape[0], step):
        try:
            check_chunks(product.path / key, array, array.ndim - 2, (row, min(row + step, shape[0])))
            array[..., row : row + step, :]
        except Exception as error:  # on damaged data each codec raises a type of its own
            rows = f"rows {row}-{min(row + step, shape[0]) - 1}"
            raise FileFormatError(product.path, f"{rows}: damaged: {error}", key) from error


def _check_cells(product: Product, chunk_rows: int) -> MeasuredCells:
    """The measured cells of a product whose images agree on which cells those are."""
    parts = []
    for row in range(0, product.grid.rows, chunk_rows):
        stop = min(row + chunk_rows, product.grid.rows)
        height, valid, source = product.height(row, stop), product.valid(row, stop), product.source(row, stop)
        if not torch.equal(torch.isfinite(height), valid):
            raise FileFormatError(product.path, f"rows {row}-{stop - 1}: heights of cells that are invalid", "valid")
        if not bool(torch.isfinite(source)[valid].all()):
            raise FileFormatError(product.path, f"rows {row}-{stop - 1}: heights without a source", "source")
        parts.append(MeasuredCells.of(height, valid))
    return MeasuredCells.total(parts)
