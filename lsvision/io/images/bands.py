"""Tall images as bands of whole lines, decoded one at a time and kept for the next read."""

from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lsvision.errors import FileFormatError

TORCH_DTYPES: dict[np.dtype, torch.dtype] = {
    np.dtype(np.uint8): torch.uint8,
    np.dtype(np.uint16): torch.uint16,
    np.dtype(np.float32): torch.float32,
}
NUMPY_DTYPES: dict[torch.dtype, np.dtype] = {torch_dtype: dtype for dtype, torch_dtype in TORCH_DTYPES.items()}

# Holds the overlap of neighbouring reads; 1500 lines of a 7142 px colour camera.
_CACHE_BYTES = 32 * 2**20
_MOST_BAND_BYTES = 2**30  # a frame of 30 000 lines of 7142 px has two thirds of it


class Bands(Protocol):
    """An image file as bands of lines that can be decoded one by one.

    ``layout`` is (lines, width, channels) as stored, ``edges`` the first line of each band and the number of lines.
    """

    path: Path
    layout: tuple[int, int, int]
    dtype: np.dtype
    edges: NDArray[np.int64]

    def decode(self, band: int) -> NDArray:
        """The lines of one band, (lines, width, channels) as stored."""
        ...


def check_band_bytes(path: Path, what: str, size: int) -> None:
    """Check what has to be decoded at once, in bytes.

    Raises:
        FileFormatError: it is more than any image of a camera needs; a file of any size may claim it.
    """
    if size > _MOST_BAND_BYTES:
        limit = f"expected pieces of at most {_MOST_BAND_BYTES >> 20} MB"
        raise FileFormatError(path, f"{limit} to be decoded at once, {what} takes {size >> 20} MB")


def even_edges(lines: int, band_lines: int) -> NDArray[np.int64]:
    """Edges of bands of equal height, the last one shorter where it must be."""
    return np.append(np.arange(0, lines, band_lines, dtype=np.int64), lines)


def _joined(ranges: Iterable[range]) -> tuple[range, ...]:
    """Ranges in order, those that touch as one."""
    joined: list[range] = []
    for lines in ranges:
        if joined and joined[-1].stop >= lines.start:
            joined[-1] = range(joined[-1].start, lines.stop)
        else:
            joined.append(lines)
    return tuple(joined)


class BandedImage:
    """A ``LineImage`` on bands; an alpha channel is dropped. It is pickled as its path and opened there again.

    Args:
        missing: lines that are not there, in order.

    Raises:
        FileFormatError: the image is empty, lacks all its lines, or has channels or a dtype that no camera delivers.
    """

    def __init__(self, bands: Bands, missing: Iterable[range] = ()) -> None:
        lines, width, channels = bands.layout
        if lines < 1 or width < 1:
            raise FileFormatError(bands.path, f"expected an image, got {lines} lines of {width} px")
        if channels not in (1, 3, 4):
            raise FileFormatError(bands.path, f"expected 1 or 3 channels (or 4 with alpha), got {channels}")
        if bands.dtype not in TORCH_DTYPES:
            raise FileFormatError(bands.path, f"expected uint8, uint16 or float32, got {bands.dtype}")
        most = int(np.diff(bands.edges).max())
        size = most * width * channels * bands.dtype.itemsize
        check_band_bytes(bands.path, f"one of {most} lines of {width} px", size)
        self._bands = bands
        self.missing = _joined(missing)
        if sum(map(len, self.missing)) == lines:
            raise FileFormatError(bands.path, f"all {lines} lines are missing")
        self._shape = (lines, width, min(channels, 3))
        self._cache: OrderedDict[int, NDArray] = OrderedDict()

    def __reduce__(self) -> tuple[type, tuple[Bands, tuple[range, ...]]]:
        return type(self), (self._bands, self.missing)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        return self._shape

    @property
    def dtype(self) -> torch.dtype:
        """uint8, uint16 or float32."""
        return TORCH_DTYPES[self._bands.dtype]

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1`` as a tensor ``(stop - start, width, channels)``.

        Raises:
            ValueError: the range is not within the image.
            FileFormatError: the lines cannot be decoded.
        """
        lines, width, channels = self._shape
        if not 0 <= start <= stop <= lines:
            raise ValueError(f"start, stop: expected a range within 0..{lines}, got {start}..{stop}")
        edges = self._bands.edges
        pixels = np.empty((stop - start, width, channels), self._bands.dtype)
        first = int(np.searchsorted(edges, start, side="right")) - 1
        for band in range(first, int(np.searchsorted(edges, stop))):
            lower, upper = max(start, int(edges[band])), min(stop, int(edges[band + 1]))
            inside = slice(lower - int(edges[band]), upper - int(edges[band]))
            pixels[lower - start : upper - start] = self._decoded(band)[inside, :, :channels]
        return torch.from_numpy(pixels)

    def _decoded(self, band: int) -> NDArray:
        if band not in self._cache:
            self._cache[band] = self._decode(band)
        self._cache.move_to_end(band)
        while len(self._cache) > 1 and sum(pixels.nbytes for pixels in self._cache.values()) > _CACHE_BYTES:
            self._cache.popitem(last=False)
        return self._cache[band]

    def _decode(self, band: int) -> NDArray:
        edges, (_, width, channels) = self._bands.edges, self._bands.layout
        lines = f"lines {edges[band]}-{edges[band + 1] - 1}"
        try:
            pixels = self._bands.decode(band)
        except (FileFormatError, MemoryError):
            raise
        except Exception as error:  # on damaged data each codec raises another type
            raise FileFormatError(self._bands.path, f"{lines} cannot be decoded: {error}") from error
        expected = (int(edges[band + 1] - edges[band]), width, channels)
        if pixels.shape != expected or pixels.dtype != self._bands.dtype:
            found = f"{pixels.shape} {pixels.dtype}"
            raise FileFormatError(self._bands.path, f"{lines}: expected {expected} {self._bands.dtype}, got {found}")
        return pixels
