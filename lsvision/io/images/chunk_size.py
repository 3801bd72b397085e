"""What a Zarr chunk would take to decode, from its first bytes: a small file can claim to hold any amount."""

import itertools
import math
import zlib
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import check_band_bytes

_HEAD_BYTES = 32
_DEFLATE_RATIO = 1032  # at most; of small chunks nothing need be looked into
_HARMLESS_BYTES = 2**26
_PLAIN = ("BytesCodec", "Crc32cCodec", "TransposeCodec")
_SIZED = ("Zstd", "Blosc", "LZ4")
_DEFLATED = ("GZip", "Gzip", "Zlib")


def check_chunks(path: Path, array: Any, axis: int, lines: tuple[int, int]) -> None:
    """Check that the chunks of some lines decode to no more than their size.

    Args:
        path: the array's folder.
        axis: that of the lines. lines: first and end.

    Raises:
        FileFormatError: a chunk is larger than any image needs, claims to hold more, or is compressed in a way that
            does not say.
    """
    expected = math.prod(array.chunks) * np.dtype(array.dtype).itemsize
    check_band_bytes(path, f"a chunk of {array.chunks}", expected)
    compressor = _compressor(path, array)
    if compressor is None or getattr(array, "shards", None) is not None:
        return  # plain bytes are checked by their length, shards by their inner chunks' places
    counts = [range(-(-size // chunk)) for size, chunk in zip(array.shape, array.chunks, strict=True)]
    size = array.chunks[axis]
    counts[axis] = range(lines[0] // size, -(-lines[1] // size))
    for place in itertools.product(*counts):
        file = path / array.metadata.encode_chunk_key(place)
        if file.is_file() and not _fits(file, compressor, expected):
            raise FileFormatError(path, f"chunk {file.relative_to(path)} holds more than its {expected} bytes")


def _compressor(path: Path, array: Any) -> str | None:
    """Name of the one codec that compresses chunks; None where none does."""
    codecs = [type(codec).__name__.removesuffix("Codec") for codec in array.compressors or ()]
    names = [name for name in codecs if f"{name}Codec" not in _PLAIN]
    if len(names) > 1 or any(name not in _SIZED + _DEFLATED for name in names):
        raise FileFormatError(path, f"expected chunks compressed by one of zstd, blosc, lz4 and gzip, got {names}")
    return names[0] if names else None


def _fits(file: Path, compressor: str, expected: int) -> bool:
    """Whether the content of a chunk fits the buffer that it belongs in."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if compressor in _DEFLATED:
        if file.stat().st_size * _DEFLATE_RATIO <= max(expected, _HARMLESS_BYTES):
            return True
        inflater = zlib.decompressobj(wbits=47)  # gzip or zlib
        inflater.decompress(file.read_bytes(), expected + 1)
        return inflater.eof
    if compressor == "Zstd":
        declared = _zstd_bytes(head)
        return _zstd_fits(file, expected) if declared is None else declared <= expected
    place = slice(4, 8) if compressor == "Blosc" else slice(0, 4)
    return int.from_bytes(head[place], "little") <= expected


def _zstd_bytes(head: bytes) -> int | None:
    """Size of the content of a Zstandard frame, RFC 8878 3.1.1.1; None where its header does not give it."""
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return 0  # no such frame: decoding it fails
    flags = head[4]
    single, kind = flags >> 5 & 1, flags >> 6
    length = (single, 2, 4, 8)[kind]
    if not length:
        return None
    begin = 5 + (1 - single) + (0, 1, 2, 4)[flags & 3]
    return int.from_bytes(head[begin : begin + length], "little") + (256 if kind == 1 else 0)


def _zstd_fits(file: Path, expected: int) -> bool:
    try:
        imagecodecs.zstd_decode(file.read_bytes(), out=bytearray(expected))
    except imagecodecs.ZstdError:
        return False
    return True
