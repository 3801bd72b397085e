"""A Zarr array (format 2 or 3) as a tall image."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import even_edges
from lsvision.io.images.chunk_size import check_chunk_count, check_chunks
from lsvision.types import MissingLines

_METADATA_FILES = ("zarr.json", ".zarray", ".zgroup")


def is_zarr(path: Path) -> bool:
    """Whether a folder is a Zarr array or group."""
    return any((path / name).is_file() for name in _METADATA_FILES)


class ZarrBands:
    """The rows of chunks of a Zarr array ``(lines, width)`` or ``(lines, width, channels)``.

    Raises:
        FileFormatError: a group, damaged metadata, an array of another number of dimensions, or an image of which
            chunks are missing, unless ``missing_lines`` is "mark": they would read as black. A float map has none where
            nothing was measured.
    """

    def __init__(self, path: Path, missing_lines: MissingLines = "refuse") -> None:
        self.path = path
        try:
            self._array = zarr.open_array(path, mode="r")
        except Exception as error:  # damaged metadata surfaces as any of a dozen types
            raise FileFormatError(path, f"not a readable Zarr array: {error}") from error
        shape = self._array.shape
        if len(shape) not in (2, 3):
            raise FileFormatError(path, f"expected an array (lines, width, channels), got shape {shape}")
        check_chunk_count(path, self._array)
        self.layout = (shape[0], shape[1], shape[2] if len(shape) == 3 else 1)
        self.dtype = np.dtype(self._array.dtype).newbyteorder("=")
        missing = self._array.nchunks - self._array.nchunks_initialized if self.dtype.kind != "f" else 0
        self.missing = _missing_rows(path, self._array) if missing > 0 and missing_lines == "mark" else []
        if missing > 0 and not self.missing:
            raise FileFormatError(path, f"{missing} of {self._array.nchunks} chunks are missing")
        self.edges = even_edges(shape[0], self._array.chunks[0])

        self._missing_lines = missing_lines

    def __reduce__(self) -> tuple[type, tuple[Path, MissingLines]]:
        return type(self), (self.path, self._missing_lines)

    def decode(self, band: int) -> NDArray:
        """The lines of one row of chunks, (lines, width, channels)."""
        check_chunks(self.path, self._array, 0, (int(self.edges[band]), int(self.edges[band + 1])))
        pixels = np.asarray(self._array[int(self.edges[band]) : int(self.edges[band + 1])])
        return pixels.astype(self.dtype, copy=False).reshape(-1, *self.layout[1:])


def _missing_rows(path: Path, array: Any) -> list[range]:
    """Lines of the rows of chunks, or of shards, of which at least one has no file."""
    size = array.shards or array.chunks
    rows, *others = (range(-(-length // step)) for length, step in zip(array.shape, size, strict=True))
    lost = [
        row
        for row in rows
        if not all(
            (path / array.metadata.encode_chunk_key((row, *place))).is_file() for place in itertools.product(*others)
        )
    ]
    return [range(row * size[0], min((row + 1) * size[0], array.shape[0])) for row in lost]
