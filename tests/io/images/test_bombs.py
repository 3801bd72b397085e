"""Small files that claim to hold any amount: refused before it is decoded."""

import gzip
import json
import os
import struct
import zlib
from pathlib import Path

import imagecodecs
import numcodecs
import numpy as np
import pytest
import tifffile
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, GzipCodec, ZstdCodec

from lsvision.errors import FileFormatError
from lsvision.io import open_line_image
from lsvision.io.images.chunk_size import _zstd_bytes
from lsvision.io.images.tiff import _jpeg_pixels

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 16, 3), dtype=np.uint8)
MB = 2**20


def png(lines: int, width: int) -> bytes:
    """A PNG whose header claims a size; its data are those of another."""
    pieces = [(b"IHDR", struct.pack(">IIBBBBB", width, lines, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(bytes(100)))]
    chunks = [struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
              for kind, data in [*pieces, (b"IEND", b"")]]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def zarr_image(path: Path, **options) -> Path:
    image = zarr.create_array(path, shape=PIXELS.shape, chunks=(20, 16, 3), dtype="uint8", **options)
    image[:] = PIXELS
    assert open_line_image(path).read(0, 40).shape == PIXELS.shape
    return path


@pytest.mark.parametrize(
    ("codec", "content"),
    [
        (ZstdCodec(), imagecodecs.zstd_encode(bytes(100 * MB))),
        (BloscCodec(cname="lz4"), numcodecs.Blosc("lz4").encode(bytes(100 * MB))),
        (GzipCodec(), numcodecs.GZip(9).encode(bytes(100 * MB))),
    ],
    ids=["zstd", "blosc", "gzip"],
)
def test_a_chunk_that_holds_more_than_its_size(tmp_path, codec, content):
    path = zarr_image(tmp_path / "a.zarr", compressors=[codec, Crc32cCodec()])
    checksum = struct.pack("<I", imagecodecs.crc32c(content)) if hasattr(imagecodecs, "crc32c") else bytes(4)
    (path / "c" / "1" / "0" / "0").write_bytes(content + checksum)
    image = open_line_image(path)
    image.read(0, 20)
    with pytest.raises(FileFormatError, match=r"a.zarr: chunk c/1/0/0 holds more than its 960 bytes"):
        image.read(10, 30)


@pytest.mark.parametrize("place", [4, 8, 12])
def test_a_blosc_chunk_whose_header_leads_beyond_it(tmp_path, place):
    """Its decoder would read there, and end the process."""
    path = zarr_image(tmp_path / "a.zarr", compressors=[BloscCodec(cname="lz4")])
    chunk = path / "c" / "1" / "0" / "0"
    content = bytearray(chunk.read_bytes())
    content[place : place + 4] = struct.pack("<I", 0x70212123)
    chunk.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"chunk c/1/0/0 holds more than its 960 bytes, or is damaged"):
        open_line_image(path).read(10, 30)


@pytest.mark.parametrize("compressor", [numcodecs.LZ4(), numcodecs.Zlib(), numcodecs.Zstd(), None])
def test_arrays_of_format_2(tmp_path, compressor):
    path = zarr_image(tmp_path / "a.zarr", zarr_format=2, compressors=compressor)
    if compressor is not None:
        (path / "1.0.0").write_bytes(compressor.encode(bytes(100 * MB)))
        with pytest.raises(FileFormatError, match=r"chunk 1.0.0 holds more than its 960 bytes"):
            open_line_image(path).read(10, 30)


def test_compressed_twice_or_in_a_way_that_tells_no_size(tmp_path):
    for name, codecs in {"twice": [ZstdCodec(), ZstdCodec()]}.items():
        with pytest.raises(FileFormatError, match="expected chunks compressed by one of zstd, blosc"):
            zarr_image(tmp_path / name, compressors=codecs)
    with pytest.raises(FileFormatError, match="expected chunks compressed by one of zstd, blosc"):
        zarr_image(tmp_path / "bz2", zarr_format=2, compressors=numcodecs.BZ2())


def zstd_of_unsaid_size(blocks: int) -> bytes:
    """A frame of Zstandard whose header does not give its size, of so many blocks of 128 KB of zeros."""
    block = 1 << 1 | 131_071 << 3  # all its bytes are the one that follows
    body = (struct.pack("<I", block)[:3] + b"\0") * (blocks - 1) + struct.pack("<I", 1 | block)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x58" + body


@pytest.mark.parametrize("before", [b"", struct.pack("<II", 0x184D2A50, 4) + b"skip"], ids=["alone", "after another"])
def test_a_zstandard_frame_that_does_not_say_its_size(tmp_path, before):
    path = zarr_image(tmp_path / "a.zarr", compressors=[ZstdCodec()])
    (path / "c" / "1" / "0" / "0").write_bytes(before + zstd_of_unsaid_size(1000))
    with pytest.raises(FileFormatError, match=r"chunk c/1/0/0 holds more than its 960 bytes"):
        open_line_image(path).read(10, 30)


def test_a_gzip_file_within_a_gzip_chunk(tmp_path):
    lines = 40_000_000
    path = tmp_path / "a.zarr"
    zarr.create_array(path, shape=(lines, 1), chunks=(lines, 1), dtype="uint8", compressors=[GzipCodec()])
    (path / "c" / "0").mkdir(parents=True)
    # The second would go on for as long as it likes: only its length is looked at.
    (path / "c" / "0" / "0").write_bytes(gzip.compress(b"") + gzip.compress(bytes(100 * MB)))
    with pytest.raises(FileFormatError, match=r"chunk c/0/0 holds more than its 40000000 bytes"):
        open_line_image(path).read(0, 1)


@pytest.mark.parametrize("compressor", [ZstdCodec(), None], ids=["zstd", "plain"])
def test_a_chunk_whose_file_is_enormous(tmp_path, compressor):
    path = zarr_image(tmp_path / "a.zarr", compressors=compressor)
    os.truncate(path / "c" / "1" / "0" / "0", 2**40)  # takes no room
    with pytest.raises(FileFormatError, match=r"chunk c/1/0/0 holds more than its 960 bytes"):
        open_line_image(path).read(10, 30)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
@pytest.mark.parametrize("missing_lines", ["refuse", "mark"])
def test_more_chunks_than_any_scan_has(tmp_path, dtype, missing_lines):
    path = tmp_path / "a.zarr"
    zarr.create_array(path, shape=(10**9, 16), chunks=(1, 16), dtype=dtype)
    with pytest.raises(FileFormatError, match="expected at most 10000000 chunks, got 1000000000"):
        open_line_image(path, missing_lines)


@pytest.mark.parametrize("name", ["gzip", "bz2", "base64"])
def test_filters_that_tell_no_size(tmp_path, name):
    path = zarr_image(tmp_path / "a.zarr", zarr_format=2, compressors=None)
    metadata = json.loads((path / ".zarray").read_text())
    (path / ".zarray").write_text(json.dumps({**metadata, "filters": [{"id": name}]}))
    with pytest.raises(FileFormatError, match="expected filters among transpose, shuffle, delta"):
        open_line_image(path).read(0, 1)


def test_a_zarr_image_of_enormous_chunks(tmp_path):
    path = zarr_image(tmp_path / "a.zarr")
    metadata = json.loads((path / "zarr.json").read_text())
    metadata["shape"] = metadata["chunk_grid"]["configuration"]["chunk_shape"] = [10**9, 16, 3]
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(FileFormatError, match="expected pieces of at most 1024 MB to be decoded at once"):
        open_line_image(path).read(0, 1)


def test_frames(tmp_path):
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "0.png").write_bytes(png(900_000, 2000))
    with pytest.raises(
        FileFormatError, match=r"0.png: expected pieces of at most 1024 MB .* 900000 lines takes 1716 MB"
    ):
        open_line_image(tmp_path / "f")


def test_a_tiff_of_one_enormous_strip(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", PIXELS, photometric="rgb", compression="zlib", rowsperstrip=40)
    content = bytearray((tmp_path / "a.tif").read_bytes())
    for tag in (257, 278):  # lines, and those of a strip
        place = content.index(struct.pack("<H", tag))
        content[place + 2 : place + 12] = struct.pack("<HII", 4, 1, 4_000_000_000)
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(FileFormatError, match="of 4000000000 lines of 16 px takes"):
        open_line_image(tmp_path / "a.tif")


def test_a_strip_whose_jpeg_is_larger(tmp_path):
    large = imagecodecs.jpeg8_encode(np.zeros((400, 16, 3), np.uint8))
    tifffile.imwrite(tmp_path / "a.tif", PIXELS, photometric="rgb", compression="jpeg", rowsperstrip=40)
    assert open_line_image(tmp_path / "a.tif").read(0, 40).shape == PIXELS.shape
    assert _jpeg_pixels(large) == 6400
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        offset, count = file.pages.first.dataoffsets[0], file.pages.first.databytecounts[0]
    content = bytearray((tmp_path / "a.tif").read_bytes())
    content[offset : offset + count] = large[:count].ljust(count, b"\0")
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(FileFormatError, match="the JPEG image of strip or tile 0 is larger than that"):
        open_line_image(tmp_path / "a.tif").read(0, 40)


@pytest.mark.parametrize("options", [{"rowsperstrip": 1}, {"tile": (16, 16)}], ids=["strips", "tiles"])
def test_a_tiff_of_more_strips_than_it_has(tmp_path, options):
    """Nothing is made of each of the strips that it claims."""
    tifffile.imwrite(tmp_path / "a.tif", PIXELS, photometric="rgb", compression="zlib", **options)
    content = bytearray((tmp_path / "a.tif").read_bytes())
    place = content.index(struct.pack("<H", 257))  # lines
    content[place + 2 : place + 12] = struct.pack("<HII", 4, 1, 4_000_000_000)
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"expected (4000|250)000000 strips or tiles, got (40|3)"):
        open_line_image(tmp_path / "a.tif")


@pytest.mark.parametrize("kind", ["jpeg2000", "webp", "png"])
def test_a_compression_whose_size_is_not_checked(tmp_path, kind):
    tifffile.imwrite(tmp_path / "a.tif", PIXELS, photometric="rgb", compression=kind)
    with pytest.raises(
        FileFormatError, match=f"expected an image that is plain or compressed by .*, got {kind.upper()}"
    ):
        open_line_image(tmp_path / "a.tif")


@pytest.mark.parametrize("size", [1, 255, 256, 65_791, 65_792, 10_000_000])
def test_the_size_of_a_zstandard_frame(size):
    assert _zstd_bytes(imagecodecs.zstd_encode(bytes(size))[:32]) == size
