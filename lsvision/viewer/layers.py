"""The images of a product as tiles: what a page of deep zoom asks for, read chunk by chunk from the pyramids.

Tiles follow the numbering of Deep Zoom: at the highest level a tile shows cells one to one, at each lower level half as
many. Levels that the pyramid lacks are its coarsest one, thinned.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import matplotlib
import numpy as np
import zarr
from numpy.typing import NDArray

from lsvision.errors import LsvisionError
from lsvision.types import ProductGrid

TILE = 256
_KEPT_CHUNKS = 24  # decoded, of all images
_SHARES = (0.01, 0.99)  # of the values, whose range the colours show at first
_APART_MM = 12.0  # under the highest places, from where on other objects are
_EVEN_SHARES = 0.98  # of the values about zero, likewise

Scale = Literal["colors", "viridis", "RdBu"]


@dataclass(frozen=True)
class Layer:
    """An image of a product to look at.

    Attributes:
        name: of the image, as ``height``. title: for a reader. sheet: the images over the same grid.
        folder: of its pyramid. grid: of its finest level. scale: how values become colours. unit: of the values.
    """

    name: str
    title: str
    sheet: str
    folder: Path
    grid: ProductGrid
    scale: Scale
    unit: str = ""
    levels: Sequence[Any] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        group = zarr.open_group(self.folder, mode="r")
        names = sorted(group.array_keys(), key=int)
        object.__setattr__(self, "levels", tuple(group[name] for name in names))

    @property
    def top(self) -> int:
        """The level of deep zoom that shows cells one to one."""
        return (max(self.grid.shape) - 1).bit_length()

    @cached_property
    def span(self) -> tuple[float, float]:
        """Least and greatest value that the colours show at first."""
        if self.scale == "colors":
            return 0.0, 255.0
        values = np.asarray(self.levels[-1][...])
        values = values[np.isfinite(values)]
        if not len(values):
            return 0.0, 1.0
        if self.scale == "RdBu":
            most = float(np.quantile(np.abs(values - np.median(values)), _EVEN_SHARES)) or 1e-3
            return -most, most
        top = float(np.quantile(values, _SHARES[1]))
        if top - float(np.quantile(values, _SHARES[0])) > _APART_MM:
            values = values[values > top - _APART_MM]  # the object, not the ground under it
        low, high = (float(value) for value in np.quantile(values, _SHARES))
        return (low, high) if high > low else (low, low + 1e-3)

    def tile(self, level: int, column: int, row: int, span: tuple[float, float] | None = None) -> bytes:
        """One tile as PNG, transparent where nothing was measured.

        Raises:
            LsvisionError: there is no such tile.
        """
        apart = self.top - level
        if not 0 <= apart <= self.top:
            raise LsvisionError(f"level: expected 0..{self.top}, got {level}")
        at = min(apart, len(self.levels) - 1)
        step = 1 << (apart - at)
        rows, columns = self.levels[at].shape[-2:]
        first_row, first_column = row * TILE * step, column * TILE * step
        if row < 0 or column < 0 or first_row >= rows or first_column >= columns:
            raise LsvisionError(f"tile: none at column {column}, row {row} of level {level}")
        block = self._block(at, first_row, min(first_row + TILE * step, rows), step)
        block = block[:, first_column : first_column + TILE * step : step]
        return _png(self._colored(block, self.span if span is None else span))

    def values(self, rows: range, columns: range) -> NDArray[Any]:
        """Values of some cells of the finest level."""
        return self._block(0, rows.start, rows.stop, 1)[:, columns.start : columns.stop]

    def _block(self, level: int, start: int, stop: int, step: int) -> NDArray[Any]:
        """Every ``step``-th row of a range of a level, channels last."""
        tall = int(self.levels[level].chunks[-2])
        parts = [
            _chunk(self, level, number)[max(start - number * tall, 0) : stop - number * tall]
            for number in range(start // tall, -(-stop // tall))
        ]
        return np.concatenate(parts)[::step]

    def _colored(self, block: NDArray[Any], span: tuple[float, float]) -> NDArray[np.uint8]:
        """Blue, green, red and opacity, as OpenCV writes them."""
        if self.scale == "colors":
            shown = (block >> 8).astype(np.uint8) if block.dtype == np.uint16 else block.astype(np.uint8)
            colors = np.repeat(shown, 3, axis=2) if shown.shape[2] == 1 else shown[..., ::-1]
            return np.dstack([colors, np.full(block.shape[:2], 255, np.uint8)])
        low, high = span
        known = np.isfinite(block)
        place = np.clip((np.where(known, block, low) - low) / (high - low), 0.0, 1.0)
        colors = _table(self.scale)[np.rint(255 * place).astype(np.uint8)]
        return np.dstack([colors, np.where(known, 255, 0).astype(np.uint8)])


@lru_cache(maxsize=_KEPT_CHUNKS)
def _chunk(layer: Layer, level: int, number: int) -> NDArray[Any]:
    """A chunk of a level, channels last: neighbouring tiles lie in the same ones."""
    array = layer.levels[level]
    tall = int(array.chunks[-2])
    block = np.asarray(array[..., number * tall : (number + 1) * tall, :])
    return np.ascontiguousarray(np.moveaxis(block, 0, -1)) if block.ndim == 3 else block


@lru_cache(maxsize=4)
def _table(scale: Scale) -> NDArray[np.uint8]:
    """Colours by value, as OpenCV orders them."""
    colors = matplotlib.colormaps[scale](np.arange(256))[:, 2::-1]
    return np.rint(255 * colors).astype(np.uint8)


def _png(image: NDArray[np.uint8]) -> bytes:
    done, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise LsvisionError("a tile cannot be encoded as PNG")
    return encoded.tobytes()
