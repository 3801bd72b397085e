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
from lsvision.types import MissingLines

FRAME_SUFFIXES = (".png", ".bmp", ".tif", ".tiff")
# Of images that are no frames; one among frames may stand for a frame that is not there.
_OTHER_IMAGES = (".jpg", ".jpeg", ".jp2", ".webp", ".gif")

# By the first two bytes. Pillow's Image.open rejects a frame of 30 000 x 7142 px as a decompression bomb, and its limit
# is global to the process; these classes read the header alone, of any size.
_HEADER_READERS: dict[bytes, type[PngImageFile | BmpImageFile]] = {b"\x89P": PngImageFile, b"BM": BmpImageFile}


class FrameBands:
    """The frames (PNG, BMP, TIFF) of a folder, one band per frame.

    Opening the folder decodes its first frame and reads the headers of all.

    Args:
        missing_lines: with "mark" missing frames count as lines that are not there, where their numbers and heights
            say how many; one before the first frame or behind the last cannot be noticed.

    Raises:
        FileFormatError: no frames, a damaged or a missing one, or frames of different kind or width.
    """

    def __init__(self, path: Path, missing_lines: MissingLines = "refuse") -> None:
        self.path = path
        frames = [file for file in path.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.name[0] != "."]
        if not frames:
            raise FileFormatError(path, f"expected a Zarr array, or frames that end in {', '.join(FRAME_SUFFIXES)}")
        frames = sorted(frames, key=_natural)
        _check_kinds(path, frames)
        heights = _frame_heights(frames)
        first = _decode_frame(frames[0])
        lost = _lost_before(path, frames, heights, missing_lines)
        self._missing_lines = missing_lines
        self._frames: list[Path | None] = []
        for frame, count in zip(frames, lost, strict=True):
            self._frames += [*([None] * count), frame]
        all_heights = np.full(len(self._frames), heights[0])
        all_heights[[frame is not None for frame in self._frames]] = heights
        self.edges = np.append(0, np.cumsum(all_heights, dtype=np.int64))
        self.layout = (int(self.edges[-1]), first.shape[1], first.shape[2])
        self.dtype = first.dtype

    def __reduce__(self) -> tuple[type, tuple[Path, MissingLines]]:
        return type(self), (self.path, self._missing_lines)

    @property
    def missing(self) -> list[range]:
        """Lines of the missing frames."""
        edges = self.edges.tolist()
        return [range(edges[i], edges[i + 1]) for i, frame in enumerate(self._frames) if frame is None]

    def decode(self, band: int) -> NDArray:
        """The lines of one frame, (lines, width, channels); of a missing one black, or NaN."""
        frame = self._frames[band]
        if frame is not None:
            return _decode_frame(frame)
        lines = int(self.edges[band + 1] - self.edges[band])
        return np.full((lines, *self.layout[1:]), np.nan if self.dtype.kind == "f" else 0, self.dtype)


def _natural(file: Path) -> list[tuple[int, str]]:
    """Sorting key by which frame 9 comes before frame 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", file.name)]


def _check_kinds(folder: Path, frames: list[Path]) -> None:
    kind = frames[0].suffix.lower()[:4]  # .tif and .tiff are one kind
    for file in sorted(folder.iterdir()):
        suffix = file.suffix.lower()
        if suffix in (*FRAME_SUFFIXES, *_OTHER_IMAGES) and file.name[0] != "." and suffix[:4] != kind:
            raise FileFormatError(file, f"expected frames of one kind only, as {frames[0].name} is")


def _frame_heights(frames: list[Path]) -> NDArray[np.int64]:
    """Lines of each frame, which must all be of one width."""
    sizes = [_frame_size(frame) for frame in frames]
    for frame, (lines, width) in zip(frames, sizes, strict=True):
        if width != sizes[0][1]:
            raise FileFormatError(frame, f"expected {sizes[0][1]} columns as {frames[0].name} has, got {width}")
        check_band_bytes(frame, f"one of {lines} lines", lines * width)
    return np.array([lines for lines, _ in sizes], dtype=np.int64)


def _lost_before(
    folder: Path, frames: list[Path], heights: NDArray[np.int64], missing_lines: MissingLines
) -> list[int]:
    """How many frames are missing before each; in frames that are numbered without a gap, none.

    Frames are numbered one by one, or by their first lines. Names may hold further numbers, as a time, if one of them
    counts.

    Raises:
        FileFormatError: frames are missing and may not be, for all behind one would move, or it is unclear how many.
    """
    numbers = _numbers_with_gaps(folder, frames, heights[:-1])
    if numbers is None:
        return [0] * len(frames)
    if missing_lines == "refuse" or len(set(numbers)) < len(numbers):
        raise _gaps_error(folder, frames, numbers)
    if (heights[:-1] != heights[0]).any() or heights[-1] > heights[0]:
        raise FileFormatError(folder, "frames are missing, and those that are there differ in height")
    steps, height = np.diff(numbers), int(heights[0])
    lost: list[int] = (steps // height if (steps % height == 0).all() else steps).tolist()
    lost = [step - 1 for step in lost]
    if sum(lost) > len(frames):
        raise FileFormatError(folder, f"{sum(lost)} frames are missing, more than the {len(frames)} that are there")
    return [0, *lost]


def _numbers_with_gaps(folder: Path, frames: list[Path], heights: NDArray[np.int64]) -> NDArray | None:
    """The number by which frames of these heights, and a last one, are counted; None where they count without a gap."""
    if len(frames) == 1:
        return None
    if len({re.sub(r"\d+", "#", frame.stem) for frame in frames}) > 1:
        raise FileFormatError(folder, f"expected frames whose names differ in a number only, as {frames[0].name}")
    columns = np.array([[int(number) for number in re.findall(r"\d+", frame.stem)] for frame in frames], dtype=object).T
    steps = [np.diff(column) for column in columns]
    if any((step == 1).all() or (step == heights).all() for step in steps):
        return None
    varying = [column for column, step in zip(columns, steps, strict=True) if (step != 0).any()]
    if len(varying) != 1:
        raise FileFormatError(folder, f"expected frames that are numbered one by one, as {frames[0].name}")
    return varying[0]


def _gaps_error(folder: Path, frames: list[Path], numbers: NDArray) -> FileFormatError:
    gaps = [(low + 1, high - 1) for low, high in pairwise(numbers.tolist()) if high != low + 1]
    shown = ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in gaps[:5] if low <= high)
    problem = f"frames {shown} are missing" if shown else "frames with equal numbers"
    return FileFormatError(
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
