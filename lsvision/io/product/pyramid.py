"""The pyramid of a product's images: every level half as fine as the one before, for viewing scans of any length.

Source: OME-NGFF 0.5, multiscales.
"""

import cv2
import numpy as np
import torch
from torch import Tensor

from lsvision.types import ProductGrid

_MIN_CELLS = 256  # along the shorter side of the coarsest level


def level_count(shape: tuple[int, int], chunk_rows: int) -> int:
    """Levels, full resolution included, of an image of (rows, columns) whose chunks can be halved with it."""
    levels = 1
    while min(level_shape(shape, levels)) >= _MIN_CELLS and chunk_rows % 2**levels == 0:
        levels += 1
    return levels


def level_shape(shape: tuple[int, int], level: int) -> tuple[int, int]:
    """(rows, columns) of a level; a cell that is half outside counts."""
    return -(-shape[0] // 2**level), -(-shape[1] // 2**level)


def halve(block: Tensor, *, average: bool) -> Tensor:
    """Rows of the next level: the mean of 2 x 2 cells, or the first of them, which invents no height or place.

    Args:
        block: ``(rows, columns)`` or ``(rows, columns, channels)``; the last row and column are repeated where odd.
    """
    if not average:
        return block[::2, ::2].clone()  # in the same order of memory
    rows, columns = block.shape[:2]
    even = np.pad(block.numpy(force=True), ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
    size = (even.shape[1] // 2, even.shape[0] // 2)
    return torch.from_numpy(cv2.resize(even, size, interpolation=cv2.INTER_AREA)).reshape(size[1], size[0], -1)


def multiscales(name: str, axes: tuple[str, ...], grid: ProductGrid, levels: int, *, averaged: bool) -> dict:
    """NGFF metadata of one image: axes in mm, and for each level its pitch and the place of its cell (0, 0).

    Args:
        averaged: whether a cell of a coarser level is centred on the cells it was made from, or on the first of them.
    """
    leading = len(axes) - 2
    datasets = []
    for level in range(levels):
        pitch = grid.pitch_mm * 2**level
        shift = (pitch - grid.pitch_mm) / 2 if averaged else 0.0
        place = [grid.origin_y_mm + shift, grid.origin_x_mm + shift]
        scale = {"type": "scale", "scale": [1.0] * leading + [pitch, pitch]}
        translation = {"type": "translation", "translation": [0.0] * leading + place}
        datasets.append({"path": str(level), "coordinateTransformations": [scale, translation]})
    image = {"name": name, "axes": [_axis(axis) for axis in axes], "datasets": datasets}
    image["type"] = "mean" if averaged else "nearest"
    return {"version": "0.5", "multiscales": [image]}


def _axis(name: str) -> dict[str, str]:
    return {"name": name, "type": "channel"} if name == "c" else {"name": name, "type": "space", "unit": "millimeter"}
