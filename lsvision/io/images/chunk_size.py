"""What a Zarr chunk would take to decode, from its first bytes: a small file can claim to hold any amount."""

import itertools
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from lsvision.errors import FileFormatError
from lsvision.io.images.bands import check_band_bytes
from lsvision.io.images.zarr_codecs import DEFLATED, ChunkCodecs, Shards, chunk_codecs

_HEAD_BYTES = 32
_DEFLATE_RATIO = 1032  # at most; of small chunks nothing need be looked into
_HARMLESS_BYTES = 2**26
_OVERHEAD_BYTES = 2**16  # of a compressor that has made more of its input
_MOST_CHUNKS = 10**7
_NOT_STORED = 2**64 - 1


@dataclass(frozen=True)
class StoredChunk:
    """Bytes of a file that are one chunk."""

    file: Path
    begin: int
    size: int

    def read(self, most: int | None = None) -> bytes:
        """Its bytes, or the first of them."""
        with self.file.open("rb") as stream:
            stream.seek(self.begin)
            return stream.read(self.size if most is None else min(most, self.size))


def check_chunks(path: Path, array: Any, axis: int, lines: tuple[int, int]) -> None:
    """Check that the chunks of some lines decode to no more than their size.

    Args:
        path: the array's folder.
        axis: that of the lines. lines: first and end.

    Raises:
        FileFormatError: a chunk is larger than any image needs, claims to hold more, lies outside its file, or is
            stored in a way that does not say what it will take.
    """
    check_chunk_count(path, array)
    expected = math.prod(array.chunks) * np.dtype(array.dtype).itemsize
    check_band_bytes(path, f"a chunk of {array.chunks}", expected)
    codecs = chunk_codecs(path, array)
    for chunk in _stored_chunks(path, array, codecs, axis, lines):
        if not _fits(chunk, codecs.compressor, expected):
            problem = f"chunk {chunk.file.relative_to(path)} holds more than its {expected} bytes, or is damaged"
            raise FileFormatError(path, problem)


def check_chunk_count(path: Path, array: Any) -> None:
    """Check how many chunks an array claims to have, before anything is made of each.

    Raises:
        FileFormatError: more than the longest scan needs.
    """
    chunks = math.prod(-(-length // chunk) for length, chunk in zip(array.shape, array.chunks, strict=True))
    if chunks > _MOST_CHUNKS:
        raise FileFormatError(path, f"expected at most {_MOST_CHUNKS} chunks, got {chunks} of {array.chunks}")


def _stored_chunks(
    path: Path, array: Any, codecs: ChunkCodecs, axis: int, lines: tuple[int, int]
) -> Iterator[StoredChunk]:
    """The chunks of some lines that are there."""
    size = array.chunks[axis]
    counts = [range(-(-length // chunk)) for length, chunk in zip(array.shape, array.chunks, strict=True)]
    counts[axis] = range(lines[0] // size, -(-lines[1] // size))
    within = codecs.shards.shape if codecs.shards else (1,) * len(counts)
    files = [range(places.start // step, -(-places.stop // step)) for places, step in zip(counts, within, strict=True)]
    for place in itertools.product(*files):
        file = path / array.metadata.encode_chunk_key(place)
        if not file.is_file():
            continue
        if codecs.shards is None:
            yield StoredChunk(file, 0, file.stat().st_size)
        else:
            inside = tuple(
                slice(max(places.start - number * step, 0), places.stop - number * step)
                for places, number, step in zip(counts, place, within, strict=True)
            )
            yield from _chunks_of_shard(path, file, codecs.shards, inside)


def _chunks_of_shard(path: Path, file: Path, shards: Shards, inside: tuple[slice, ...]) -> Iterator[StoredChunk]:
    """The chunks of a part of a shard that are there.

    Raises:
        FileFormatError: the index does not fit into the file, or leads out of it.
    """
    stored = file.stat().st_size
    index = _shard_index(path, file, shards, stored)
    # A shard that is wanted whole is read whole: what lies in it beside its chunks would be read too.
    offsets, sizes = index[..., 0], index[..., 1]
    there = (offsets != _NOT_STORED) | (sizes != _NOT_STORED)
    beyond = (offsets > stored) | (sizes > stored) | (offsets + np.minimum(sizes, stored) > stored)
    taken = int(sizes[there & ~beyond].sum(dtype=np.uint64))
    if bool((there & beyond).any()) or stored > taken + index.nbytes + shards.trailer + _OVERHEAD_BYTES:
        raise FileFormatError(path, f"the index of shard {file.relative_to(path)} does not fit its content")
    for offset, size in index[inside].reshape(-1, 2)[there[inside].reshape(-1)].tolist():
        yield StoredChunk(file, offset, size)


def _shard_index(path: Path, file: Path, shards: Shards, stored: int) -> NDArray[np.uint64]:
    """Offset and size of every chunk of a shard, (*shape of the shard, 2)."""
    size = 16 * math.prod(shards.shape)
    if size + shards.trailer > stored:
        raise FileFormatError(path, f"shard {file.relative_to(path)} is shorter than an index of {shards.shape} chunks")
    begin = 0 if shards.at_start else stored - size - shards.trailer
    return np.fromfile(file, f"{shards.byte_order}u8", size // 8, offset=begin).reshape(*shards.shape, 2)


def _fits(chunk: StoredChunk, compressor: str | None, expected: int) -> bool:
    """Whether the content of a chunk fits the buffer that it belongs in."""
    if chunk.size > 2 * expected + _OVERHEAD_BYTES:  # it would be read as a whole, compressed or not
        return False
    if compressor is None:
        return True  # bytes are checked by their number
    if compressor in DEFLATED:
        return _deflated_fits(chunk, expected)
    head = chunk.read(_HEAD_BYTES)
    if compressor == "Zstd":
        declared = _zstd_bytes(head)
        return _zstd_fits(chunk, expected) if declared is None else declared <= expected
    if compressor == "Blosc":
        return _blosc_fits(head, chunk.size, expected)
    return int.from_bytes(head[:4], "little") <= expected


def _deflated_fits(chunk: StoredChunk, expected: int) -> bool:
    if chunk.size * _DEFLATE_RATIO <= max(expected, _HARMLESS_BYTES):
        return True
    inflater = zlib.decompressobj(wbits=47)  # gzip or zlib
    inflater.decompress(chunk.read(), expected + 1)
    return inflater.eof and not inflater.unused_data  # behind which gzip would go on


def _blosc_fits(head: bytes, stored: int, expected: int) -> bool:
    """Whether a Blosc header's sizes are possible: its decoder believes them, and reads beyond the end of the file."""
    content, block, compressed = struct.unpack("<III", head[4:16].ljust(12, b"\0"))
    return len(head) >= 16 and content <= expected and block <= max(content, 1) and 16 <= compressed <= stored


def _zstd_bytes(head: bytes) -> int | None:
    """Size of the content of a Zstandard frame, RFC 8878 3.1.1.1; None where its header does not give it."""
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return None  # damaged, or a frame to be skipped
    flags = head[4]
    single, kind = flags >> 5 & 1, flags >> 6
    length = (single, 2, 4, 8)[kind]
    if not length:
        return None
    begin = 5 + (1 - single) + (0, 1, 2, 4)[flags & 3]
    return int.from_bytes(head[begin : begin + length], "little") + (256 if kind == 1 else 0)


def _zstd_fits(chunk: StoredChunk, expected: int) -> bool:
    try:
        imagecodecs.zstd_decode(chunk.read(), out=bytearray(expected))
    except imagecodecs.ZstdError:
        return False
    return True
