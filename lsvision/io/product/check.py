"""Re-reading a product: every chunk against its checksum, and the images against each other."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import zarr

from lsvision.errors import FileFormatError
from lsvision.io.product.pyramid import level_shape, multiscales
from lsvision.io.product.reader import image_names, read_product


@dataclass(frozen=True)
class ProductCheck:
    """What was found in a product that is whole: cells in all, their share with a height, and the range of those."""

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
    path = Path(path)
    product = read_product(path)
    root = zarr.open_group(path, mode="r")
    levels = {name: sorted(int(level) for level in root[name].array_keys()) for name in image_names(root)}
    for name, found in levels.items():
        _check_metadata(path, name, root[name], found, product.pitch_mm, product.origin_mm)
        for level in found:
            _check_level(path, f"{name}/{level}", root[f"{name}/{level}"], level_shape(product.shape, level))
    valid, low, high = _check_cells(path, root)
    rows, columns = product.shape
    return ProductCheck(rows, columns, len(levels["height"]), valid / (rows * columns), low, high)


def _check_metadata(
    path: Path, name: str, group: Any, levels: list[int], pitch_mm: float, origin_mm: tuple[float, float]
) -> None:
    axes = ("c", "y", "x") if group["0"].ndim == 3 else ("y", "x")
    expected = multiscales(name, axes, pitch_mm, origin_mm, len(levels), averaged=name == "color")
    if levels != list(range(len(levels))) or group.attrs.get("ome") != expected:
        raise FileFormatError(path, "the metadata do not describe the image and its pyramid in NGFF 0.5", f"{name}.ome")


def _check_level(path: Path, key: str, array: Any, shape: tuple[int, int]) -> None:
    """Shape and checksums of one level; a chunk whose checksum fails cannot be read."""
    if array.shape[-2:] != shape:
        raise FileFormatError(path, f"expected {shape[0]} x {shape[1]} cells, got {array.shape}", key)
    if array.nchunks_initialized != array.nchunks:
        missing = array.nchunks - array.nchunks_initialized
        raise FileFormatError(path, f"{missing} of {array.nchunks} chunks are missing", key)
    step = array.chunks[-2]
    for row in range(0, shape[0], step):
        try:
            array[..., row : row + step, :]
        except Exception as error:  # on damaged data each codec raises a type of its own
            raise FileFormatError(path, f"rows {row}-{min(row + step, shape[0]) - 1}: damaged: {error}", key) from error


def _check_cells(path: Path, root: Any) -> tuple[int, float, float]:
    """Number of valid cells and the range of their heights; that the images agree on which cells those are."""
    heights, valids, sources = root["height/0"], root["valid/0"], root["source/0"]
    step = heights.chunks[0]
    count, low, high = 0, math.inf, -math.inf
    for row in range(0, heights.shape[0], step):
        height = torch.from_numpy(heights[row : row + step])
        valid = torch.from_numpy(valids[row : row + step])
        source = torch.from_numpy(sources[:, row : row + step])
        if not torch.equal(torch.isfinite(height), valid):
            raise FileFormatError(path, f"rows {row}-{row + len(valid) - 1}: heights where there are none", "valid")
        if not bool(torch.isfinite(source)[:, valid].all()):
            raise FileFormatError(path, f"rows {row}-{row + len(valid) - 1}: heights from nowhere", "source")
        measured = height[valid]
        if measured.numel():
            count += measured.numel()
            low, high = min(low, float(measured.min())), max(high, float(measured.max()))
    return count, low, high
