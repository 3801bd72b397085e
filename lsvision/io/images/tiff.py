"""TIFF and BigTIFF: read by the strips and tiles of the file, written strip by strip."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import imagecodecs
import numpy as np
import tifffile
import torch
from numpy.typing import NDArray
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.io.atomic import partial_file
from lsvision.io.images.bands import NUMPY_DTYPES, even_edges

Compression = Literal["zstd", "none"]

# Strips of whole lines suit readers by line range, and unlike tiles need no width that is a multiple of 16.
STRIP_LINES = 256

# On line images after the predictor, level 1 is eight times as fast as the default 3 and no larger.
ZSTD_LEVEL = 1


# Those that decode into a buffer of the right size, whatever a damaged file says, and JPEG, whose size is checked.
COMPRESSIONS = ("NONE", "LZW", "DEFLATE", "ADOBE_DEFLATE", "PACKBITS", "LZMA", "ZSTD", "ZSTD_DEPRECATED", "JPEG")


class TiffBands:
    """The strips, or rows of tiles, of a TIFF of one page.

    Raises:
        FileFormatError: not a TIFF, several pages, separate colour planes, unusual photometry, or cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with tifffile.TiffFile(path) as file:
                if len(file.pages) != 1:
                    raise FileFormatError(path, f"expected a TIFF of one page, got {len(file.pages)} pages")
                self._take_layout(file.pages.first)
        except FileFormatError:
            raise
        except Exception as error:  # a damaged header surfaces as any of a dozen types
            raise FileFormatError(path, f"not a readable TIFF: {error}") from error
        self._check_segments()

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return type(self), (self.path,)

    def decode(self, band: int) -> NDArray:
        """The lines of one band, (lines, width, channels)."""
        lines = int(self.edges[band + 1] - self.edges[band])
        _, width, channels = self.layout
        if self._raw_dtype is not None:
            offset = self._offsets[0] + int(self.edges[band]) * width * channels * self.dtype.itemsize
            pixels = np.fromfile(self.path, self._raw_dtype, lines * width * channels, offset=offset)
            return pixels.reshape(lines, width, channels).astype(self.dtype, copy=False)
        first = band * self._across
        with self.path.open("rb") as file:
            segments = [self._segment(file, index)[:lines] for index in range(first, first + self._across)]
        return np.concatenate(segments, axis=1)[:, :width]

    def _segment(self, file: Any, index: int) -> NDArray:
        file.seek(self._offsets[index])
        data = file.read(self._counts[index])
        if self._is_jpeg and _jpeg_pixels(data) > self._segment_pixels:
            raise FileFormatError(self.path, f"the JPEG image of strip or tile {index} is larger than that")
        pixels, *_ = self._decode(data, index, **self._tables)
        return pixels[0]

    def _take_layout(self, page: Any) -> None:
        if page.samplesperpixel > 1 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            raise FileFormatError(self.path, "expected interleaved channels, got separate colour planes")
        if page.photometric.name not in ("MINISBLACK", "RGB", "YCBCR"):
            raise FileFormatError(self.path, f"expected a grey or RGB image, got {page.photometric.name}")
        orientation = page.tags.valueof("Orientation", default=1)
        if orientation != 1:
            problem = (
                f"expected the first line at the top and the first column at the left, got orientation {orientation}"
            )
            raise FileFormatError(self.path, problem)
        if page.compression.name not in COMPRESSIONS:
            problem = f"expected an image that is plain or compressed by {', '.join(COMPRESSIONS[1:])}"
            raise FileFormatError(self.path, f"{problem}, got {page.compression.name}")
        if page.imagedepth != 1 or page.dtype is None:
            raise FileFormatError(self.path, "expected a two-dimensional image of plain numbers")
        self.layout = (page.imagelength, page.imagewidth, page.samplesperpixel)
        self.dtype = np.dtype(page.dtype).newbyteorder("=")
        self._offsets, self._counts = tuple(page.dataoffsets), tuple(page.databytecounts)
        self._across = -(-page.imagewidth // page.tilewidth) if page.is_tiled else 1
        band_lines = page.tilelength if page.is_tiled else min(page.rowsperstrip, page.imagelength)
        self._segment_pixels = band_lines * (page.tilewidth if page.is_tiled else page.imagewidth)
        self._is_jpeg = page.compression.name == "JPEG"
        self._raw_dtype = None
        if page.is_final:  # uncompressed and contiguous, often a single strip: any lines can be read
            self._raw_dtype = self.dtype.newbyteorder(page.parent.byteorder)
            self._offsets, self._counts = self._offsets[:1], (page.nbytes,)
            band_lines = STRIP_LINES
        else:
            self._check_count(-(-page.imagelength // band_lines) * self._across)
        self.edges = even_edges(page.imagelength, band_lines)
        self._decode = page.decode
        self._tables = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader}

    def _check_count(self, expected: int) -> None:
        if len(self._offsets) != expected or len(self._counts) != expected:
            raise FileFormatError(
                self.path, f"not a readable TIFF: expected {expected} strips or tiles, got {len(self._offsets)}"
            )

    def _check_segments(self) -> None:
        if min(self._counts) == 0 or min(self._offsets) == 0:
            raise FileFormatError(self.path, "a strip or tile was never written")
        last_byte = max(offset + count for offset, count in zip(self._offsets, self._counts, strict=True))
        size = self.path.stat().st_size
        if last_byte > size:
            raise FileFormatError(self.path, f"cut short: its data reach to byte {last_byte}, the file ends at {size}")


def _jpeg_pixels(data: bytes) -> int:
    """Pixels of a JPEG image by its frame header, ITU-T T.81 B.2.2; 0 where there is none, which no decoder takes."""
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            lines, width = (int.from_bytes(data[place + at : place + at + 2], "big") for at in (5, 7))
            return lines * width
        place += 1 if marker == 0xFF else 2 + length
    return 0


def write_line_image(
    path: Path | str,
    strips: Iterable[Tensor],
    shape: tuple[int, int, int],
    dtype: torch.dtype,
    *,
    compression: Compression = "zstd",
) -> None:
    """Write a BigTIFF of 256-line strips from blocks of lines of any height, with one block in memory at a time.

    Args:
        path: final file; it appears when complete.
        strips: blocks ``(lines, width, channels)`` in order.
        shape: (lines, width, channels) of the whole; 1 or 3 channels.
        dtype: uint8, uint16 or float32. Whole numbers get the horizontal predictor, float32 none.
        compression: "zstd" or "none".

    Raises:
        ValueError: blocks that do not have ``dtype`` or do not add up to ``shape``.
    """
    if len(shape) != 3 or min(shape) < 1 or shape[2] not in (1, 3):
        raise ValueError(f"shape: expected (lines, width, 1 or 3), got {shape}")
    if dtype not in NUMPY_DTYPES:
        raise ValueError(f"dtype: expected uint8, uint16 or float32, got {dtype}")
    delta = compression == "zstd" and dtype != torch.float32
    blocks = _blocks(strips, shape, dtype)
    with partial_file(path) as partial:
        tifffile.imwrite(
            partial,
            (_encoded(block, compression, delta) for block in blocks),
            shape=shape if shape[2] == 3 else shape[:2],
            dtype=NUMPY_DTYPES[dtype],
            bigtiff=True,
            photometric="rgb" if shape[2] == 3 else "minisblack",
            rowsperstrip=STRIP_LINES,
            compression=None if compression == "none" else compression,
            predictor=2 if delta else None,
            metadata=None,
        )
        next(blocks, None)  # the writer stops at the last line; this raises where blocks go beyond it


def _encoded(block: NDArray, compression: Compression, delta: bool) -> bytes:
    if compression == "none":
        return block.tobytes()
    pixels = imagecodecs.delta_encode(block, axis=1) if delta else block
    return bytes(imagecodecs.zstd_encode(pixels.tobytes(), level=ZSTD_LEVEL))


def _blocks(strips: Iterable[Tensor], shape: tuple[int, int, int], dtype: torch.dtype) -> Iterator[NDArray]:
    """Blocks of STRIP_LINES lines; each is valid until the next is generated."""
    block = np.empty((STRIP_LINES, *shape[1:]), NUMPY_DTYPES[dtype])
    lines = filled = 0
    for strip in strips:
        if strip.dtype != dtype or strip.ndim != 3 or tuple(strip.shape[1:]) != tuple(shape[1:]):
            expected = f"(lines, {shape[1]}, {shape[2]}) {dtype}"
            raise ValueError(f"strips: expected {expected}, got {tuple(strip.shape)} {strip.dtype}")
        lines += len(strip)
        if lines > shape[0]:
            raise ValueError(f"strips: expected {shape[0]} lines, got more")
        pixels = strip.numpy(force=True)
        while len(pixels):
            part = pixels[: STRIP_LINES - filled]
            block[filled : filled + len(part)] = part
            pixels, filled = pixels[len(part) :], filled + len(part)
            if filled == STRIP_LINES:
                yield block
                filled = 0
    if lines != shape[0]:
        raise ValueError(f"strips: expected {shape[0]} lines, got {lines}")
    if filled:
        yield block[:filled]
