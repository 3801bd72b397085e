"""Zarr images of many chunks to a file: read by lines, and never beyond what their index can mean."""

import json
import os
import struct
from pathlib import Path

import google_crc32c
import imagecodecs
import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, GzipCodec, ShardingCodec, ZstdCodec

from lsvision.errors import FileFormatError
from lsvision.io import open_line_image

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 16, 3), dtype=np.uint8)
GOOD = imagecodecs.zstd_encode(PIXELS[:10].tobytes())
MB = 2**20


def sharded(path: Path, chunks: tuple[int, int, int] = (10, 16, 3), **options) -> Path:
    options = {"compressors": [ZstdCodec()], **options}
    image = zarr.create_array(path, shape=PIXELS.shape, chunks=chunks, shards=(20, 16, 3), dtype="uint8", **options)
    image[:] = PIXELS
    return path


def shard(*chunks: bytes, index: tuple[int, ...] = ()) -> bytes:
    """A shard of some chunks, with the index that it claims: offset and size of each."""
    places = [value for number, chunk in enumerate(chunks) for value in (sum(map(len, chunks[:number])), len(chunk))]
    stored = struct.pack(f"<{2 * len(chunks)}Q", *(index or places))
    return b"".join(chunks) + stored + struct.pack("<I", google_crc32c.value(stored))


@pytest.mark.parametrize("codecs", [[ZstdCodec()], [GzipCodec()], [BloscCodec()], [ZstdCodec(), Crc32cCodec()], []])
@pytest.mark.parametrize("chunks", [(10, 16, 3), (5, 8, 3), (20, 16, 1)])
def test_any_lines(tmp_path, codecs, chunks):
    image = open_line_image(sharded(tmp_path / "a.zarr", chunks, compressors=codecs))
    for start, stop in ((0, 40), (13, 27), (39, 40)):
        assert np.array_equal(image.read(start, stop).numpy(), PIXELS[start:stop])


@pytest.mark.parametrize("location", ["start", "end"])
def test_an_index_at_either_end(tmp_path, location):
    codecs = [BytesCodec(), ZstdCodec()]
    codec = ShardingCodec(chunk_shape=(10, 16, 3), codecs=codecs, index_location=location)
    image = zarr.create_array(
        tmp_path / "a.zarr", shape=PIXELS.shape, chunks=(20, 16, 3), dtype="uint8", serializer=codec, compressors=None
    )
    image[:] = PIXELS
    assert np.array_equal(open_line_image(tmp_path / "a.zarr").read(5, 35).numpy(), PIXELS[5:35])


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (shard(GOOD, imagecodecs.zstd_encode(bytes(100 * MB))), "chunk c/1/0/0 holds more than its 480 bytes"),
        (shard(GOOD, GOOD, index=(0, len(GOOD), 2**63, 9)), "the index of shard c/1/0/0 does not fit its content"),
        (shard(GOOD, GOOD, index=(2**64 - 2, 9, 0, 2**64 - 2)), "the index of shard c/1/0/0 does not fit its content"),
        (b"short", "shard c/1/0/0 is shorter than an index"),
        (b"", "shard c/1/0/0 is shorter than an index"),
    ],
    ids=["bomb", "outside", "round the end", "short", "empty"],
)
def test_shards_that_claim_what_cannot_be(tmp_path, content, problem):
    path = sharded(tmp_path / "a.zarr")
    (path / "c" / "1" / "0" / "0").write_bytes(content)
    image = open_line_image(path)
    image.read(0, 20)
    with pytest.raises(FileFormatError, match=problem):
        image.read(20, 40)


def test_a_shard_whose_file_is_enormous(tmp_path):
    path = sharded(tmp_path / "a.zarr")
    os.truncate(path / "c" / "1" / "0" / "0", 2**40)  # takes no room
    with pytest.raises(FileFormatError, match="the index of shard c/1/0/0 does not fit its content"):
        open_line_image(path).read(10, 30)


def nested(codecs: list) -> None:
    inner = {**codecs[0], "configuration": {**codecs[0]["configuration"], "chunk_shape": [5, 16, 3]}}
    codecs[0]["configuration"]["codecs"] = [inner]


def compressed_again(codecs: list) -> None:
    codecs.append({"name": "zstd", "configuration": {"level": 0, "checksum": False}})


def compressed_index(codecs: list) -> None:
    codecs[0]["configuration"]["index_codecs"][1] = {"name": "gzip", "configuration": {"level": 1}}


@pytest.mark.filterwarnings("ignore:Combining a `sharding_indexed` codec")
@pytest.mark.parametrize("change", [nested, compressed_again, compressed_index])
def test_shards_whose_size_cannot_be_told(tmp_path, change):
    path = sharded(tmp_path / "a.zarr")
    metadata = json.loads((path / "zarr.json").read_text())
    change(metadata["codecs"])
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(FileFormatError, match=r"got \['?(Sharding|Gzip)"):
        open_line_image(path).read(0, 20)
