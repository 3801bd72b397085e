"""How the chunks of a Zarr array are stored: the few codecs whose output has a size that is known beforehand."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lsvision.errors import FileFormatError

SIZED = ("Zstd", "Blosc", "LZ4")
DEFLATED = ("GZip", "Gzip", "Zlib")
_ORDERED = ("Transpose", "Shuffle", "Delta")  # as many bytes out as in
_CHECKED = ("Crc32c",)
_SHARD_INDEX = ("Bytes", "Crc32c")
_CHECKSUM_BYTES = 4


@dataclass(frozen=True)
class Shards:
    """Files of several chunks each, with an index of where they lie: offset and length of each, as unsigned 64 bits.

    ``shape`` is a shard's in chunks; the index has ``trailer`` bytes behind it and stands at the file's start or end.
    """

    shape: tuple[int, ...]
    at_start: bool
    byte_order: str
    trailer: int


@dataclass(frozen=True)
class ChunkCodecs:
    """The codec that compresses chunks, None where none does, and the shards that they lie in, where they do."""

    compressor: str | None
    shards: Shards | None


def chunk_codecs(path: Path, array: Any) -> ChunkCodecs:
    """The codecs of an array.

    Raises:
        FileFormatError: others than these; what they make of some bytes is not known before it is made.
    """
    if array.metadata.zarr_format == 2:
        _refuse_others(path, [_name(codec) for codec in array.metadata.filters or ()], _ORDERED, "filters")
        compressors = [array.metadata.compressor] if array.metadata.compressor is not None else []
        return ChunkCodecs(_compressor(path, compressors), None)
    stored = array.metadata.codecs
    sharding = stored[0] if len(stored) == 1 and _name(stored[0]) == "Sharding" else None
    codecs = sharding.codecs if sharding is not None else stored
    compressor = _compressor(path, [codec for codec in codecs if _name(codec) not in (*_ORDERED, "Bytes", *_CHECKED)])
    return ChunkCodecs(compressor, None if sharding is None else _shards(path, array, sharding))


def _shards(path: Path, array: Any, sharding: Any) -> Shards:
    index = [_name(codec) for codec in sharding.index_codecs]
    _refuse_others(path, index, _SHARD_INDEX, "codecs of the index of a shard")
    return Shards(
        shape=tuple(size // chunk for size, chunk in zip(array.shards, array.chunks, strict=True)),
        at_start=sharding.index_location.value == "start",
        byte_order=">" if getattr(sharding.index_codecs[0].endian, "value", "little") == "big" else "<",
        trailer=_CHECKSUM_BYTES * index.count("Crc32c"),
    )


def _compressor(path: Path, codecs: list[Any]) -> str | None:
    names = [_name(codec) for codec in codecs]
    if len(names) > 1 or any(name not in SIZED + DEFLATED for name in names):
        raise FileFormatError(path, f"expected chunks compressed by one of zstd, blosc, lz4 and gzip, got {names}")
    return names[0] if names else None


def _refuse_others(path: Path, names: list[str], known: tuple[str, ...], what: str) -> None:
    others = [name for name in names if name not in known]
    if others:
        raise FileFormatError(path, f"expected {what} among {', '.join(known).lower()}, got {others}")


def _name(codec: Any) -> str:
    return type(codec).__name__.removesuffix("Codec")
