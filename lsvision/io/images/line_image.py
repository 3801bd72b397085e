"""Opening a tall image in any of the formats."""

from pathlib import Path

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import BandedImage
from lsvision.io.images.frames import FrameBands
from lsvision.io.images.tiff import TiffBands
from lsvision.io.images.zarr_array import ZarrBands, is_zarr
from lsvision.types import LineImage, MissingLines

_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def open_line_image(path: Path | str, missing_lines: MissingLines = "refuse") -> LineImage:
    """Open a TIFF or BigTIFF, a Zarr array, or a folder of frames to be read by line ranges.

    A read decodes the strips, tiles, chunks or frames that the range touches. The latest are kept, so that overlapping
    reads in order decode each about once. The image holds no open file and is pickled as its path.

    Args:
        missing_lines: with "mark" an image without some of its frames or chunks is opened; ``missing`` has their lines.

    Raises:
        FileFormatError: no such file, another kind of file, or one that is damaged or cut short.
    """
    path = Path(path)
    if path.is_dir():
        bands = ZarrBands(path, missing_lines) if is_zarr(path) else FrameBands(path, missing_lines)
        return BandedImage(bands, bands.missing)
    if not path.is_file():
        raise FileFormatError(path, "no such image")
    with path.open("rb") as file:
        magic = file.read(4)
    if magic not in _TIFF_MAGIC:
        raise FileFormatError(path, "expected a TIFF, a Zarr array or a folder of frames")
    return BandedImage(TiffBands(path))
