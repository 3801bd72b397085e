"""A folder of equally wide frames, stacked in natural order."""

import re
from itertools import pairwise
from pathlib import Path

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from PIL.BmpImagePlugin import BmpImageFile
from PIL.PngImagePlugin import PngImageFile

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import BandedImage, check_band_bytes
from lsvision.io.images.tiff import TiffBands

FRAME_SUFFIXES = (".png", ".bmp", ".tif", ".tiff")
# Of images that are no frames; one among frames may stand for a frame that is not there.
_OTHER_IMAGES = (".jpg", ".jpeg", ".jp2", ".webp", ".gif")

# By the first two bytes. Pillow's Image.open rejects a frame of 30 000 x 7142 px as a decompression bomb, and its limit
# is global to the process; these classes read the header alone, of any size.
_HEADER_READERS: dict[bytes, type[PngImageFile | BmpImageFile]] = {b"\x89P": PngImageFile, b"BM": BmpImageFile}


class FrameBands:
    """The frames (PNG, BMP, TIFF) of a folder, one band per frame.

    Opening the folder decodes its first frame and reads the headers of all.

    Raises:
        FileFormatError: no frames, a damaged or a missing one, or frames of different kind or width.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        frames = [file for file in path.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.name[0] != "."]
        if not frames:
            raise FileFormatError(path, f"expected a Zarr array, or frames that end in {', '.join(FRAME_SUFFIXES)}")
        self._frames = sorted(frames, key=_natural)
        _check_kinds(path, self._frames)
        sizes = [_frame_size(frame) for frame in self._frames]
        for frame, (lines, width) in zip(self._frames, sizes, strict=True):
            if width != sizes[0][1]:
                raise FileFormatError(
                    frame, f"expected {sizes[0][1]} columns as {self._frames[0].name} has, got {width}"
                )
            check_band_bytes(frame, f"one of {lines} lines", lines * width)
        first = _decode_frame(self._frames[0])
        self.edges = np.cumsum([0, *(lines for lines, _ in sizes)], dtype=np.int64)
        _check_sequence(path, self._frames, self.edges[:-1])
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


def _check_kinds(folder: Path, frames: list[Path]) -> None:
    kind = frames[0].suffix.lower()[:4]  # .tif and .tiff are one kind
    for file in sorted(folder.iterdir()):
        suffix = file.suffix.lower()
        if suffix in (*FRAME_SUFFIXES, *_OTHER_IMAGES) and file.name[0] != "." and suffix[:4] != kind:
            raise FileFormatError(file, f"expected frames of one kind only, as {frames[0].name} is")


def _check_sequence(folder: Path, frames: list[Path], first_lines: NDArray[np.int64]) -> None:
    """Check that frames are numbered one by one, or by their first lines: a lost one would move all behind it.

    Names may hold further numbers, as a time, if one of them counts.
    """
    if len(frames) == 1:
        return
    if len({re.sub(r"\d+", "#", frame.stem) for frame in frames}) > 1:
        raise FileFormatError(folder, f"expected frames whose names differ in a number only, as {frames[0].name}")
    columns = np.array([[int(number) for number in re.findall(r"\d+", frame.stem)] for frame in frames], dtype=object).T
    steps = [np.diff(column) for column in columns]
    if any((step == 1).all() or (step == np.diff(first_lines)).all() for step in steps):
        return
    varying = [column for column, step in zip(columns, steps, strict=True) if (step != 0).any()]
    if len(varying) != 1:
        raise FileFormatError(folder, f"expected frames that are numbered one by one, as {frames[0].name}")
    gaps = [(low + 1, high - 1) for low, high in pairwise(varying[0].tolist()) if high != low + 1]
    shown = ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in gaps[:5] if low <= high)
    problem = f"frames {shown} are missing" if shown else "frames with equal numbers"
    raise FileFormatError(
        folder, f"{problem}{', ...' if len(gaps) > 5 else ''} ({frames[0].name} to {frames[-1].name})"
    )


def _frame_size(file: Path) -> tuple[int, int]:
    """(lines, width) from the header alone."""
    if file.suffix.lower() in (".tif", ".tiff"):
        return TiffBands(file).layout[:2]
    with file.open("rb") as stream:
        reader = _HEADER_READERS.get(stream.read(2))
        stream.seek(0)
        if reader is None:
            raise FileFormatError(file, "expected a PNG, BMP or TIFF image")
        try:
            width, lines = reader(stream).size
        except (SyntaxError, OSError, ValueError) as error:  # a damaged header is any of these to Pillow
            raise FileFormatError(file, f"not a readable image: {error}") from error
    return lines, width


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
