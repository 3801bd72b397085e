"""A folder of equally wide frames, stacked in natural order."""

import re
import struct
from pathlib import Path

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import BandedImage
from lsvision.io.images.tiff import TiffBands

FRAME_SUFFIXES = (".png", ".bmp", ".tif", ".tiff")


class FrameBands:
    """The frames (PNG, BMP, TIFF) of a folder, one a band; opening it decodes the first and reads headers of the rest.

    Raises:
        FileFormatError: no frames, or frames of different width.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        frames = [file for file in path.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.name[0] != "."]
        if not frames:
            raise FileFormatError(path, f"expected a Zarr array, or frames that end in {', '.join(FRAME_SUFFIXES)}")
        self._frames = sorted(frames, key=_natural)
        sizes = [_frame_size(frame) for frame in self._frames]
        for frame, (_, width) in zip(self._frames, sizes, strict=True):
            if width != sizes[0][1]:
                raise FileFormatError(
                    frame, f"expected {sizes[0][1]} columns as {self._frames[0].name} has, got {width}"
                )
        first = _decode_frame(self._frames[0])
        self.edges = np.cumsum([0, *(lines for lines, _ in sizes)], dtype=np.int64)
        self.layout = (int(self.edges[-1]), first.shape[1], first.shape[2])
        self.dtype = first.dtype

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return type(self), (self.path,)

    def decode(self, band: int) -> NDArray:
        """The lines of one frame, (lines, width, channels)."""
        return _decode_frame(self._frames[band])


def _natural(file: Path) -> list[tuple[int, str]]:
    """Sorting key by which frame 9 comes before frame 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", file.name)]


def _frame_size(file: Path) -> tuple[int, int]:
    """(lines, width) from the header alone."""
    if file.suffix.lower() in (".tif", ".tiff"):
        return TiffBands(file).layout[:2]
    with file.open("rb") as stream:
        header = stream.read(26)
    if header[:8] == b"\x89PNG\r\n\x1a\n" and len(header) == 26:
        width, lines = struct.unpack(">II", header[16:24])
        return lines, width
    if header[:2] == b"BM" and len(header) == 26:
        width, lines = struct.unpack("<ii", header[18:26])
        return abs(lines), width  # a negative height means that the top line comes first
    raise FileFormatError(file, "expected a PNG, BMP or TIFF image")


def _decode_frame(file: Path) -> NDArray:
    if file.suffix.lower() in (".tif", ".tiff"):
        image = BandedImage(TiffBands(file))
        return image.read(0, image.shape[0]).numpy()
    data = file.read_bytes()
    try:
        pixels = imagecodecs.png_decode(data) if data[:1] == b"\x89" else imagecodecs.bmp_decode(data)
    except (imagecodecs.PngError, imagecodecs.BmpError, ValueError) as error:
        raise FileFormatError(file, f"cannot be decoded: {error}") from error
    return pixels.reshape(*pixels.shape[:2], -1)
