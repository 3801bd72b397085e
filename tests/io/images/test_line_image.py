import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
import zarr

from lsvision.errors import FileFormatError
from lsvision.io import open_line_image, write_line_image
from lsvision.io.images.bands import BandedImage

COLOR = np.random.default_rng(1).integers(0, 256, (300, 48, 3), dtype=np.uint8)
MONO16 = np.random.default_rng(2).integers(0, 65536, (300, 48), dtype=np.uint16)
DEPTH = np.where(MONO16 < 9000, np.nan, MONO16 / 7).astype(np.float32)


def assert_reads(path: Path, expected: np.ndarray) -> None:
    expected = torch.from_numpy(expected.reshape(*expected.shape[:2], -1))
    image = open_line_image(path)
    assert image.shape == tuple(expected.shape)
    assert image.dtype == expected.dtype
    for start, stop in [(0, 300), (17, 130), (129, 131), (299, 300), (5, 5), (300, 300)]:
        pixels = image.read(start, stop)
        assert pixels.dtype == expected.dtype
        np.testing.assert_array_equal(pixels.numpy(), expected[start:stop].numpy())


@pytest.mark.parametrize("pixels", [COLOR, MONO16, DEPTH], ids=["color", "mono16", "depth"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"bigtiff": True, "rowsperstrip": 7},
        {"rowsperstrip": 64, "compression": "zlib", "predictor": True},
        {"rowsperstrip": 50, "compression": "lzw", "byteorder": ">", "predictor": True},
        {"compression": "zstd", "rowsperstrip": 300},
        {"byteorder": ">"},
        {"tile": (16, 32)},
        {"tile": (64, 32), "compression": "zstd", "predictor": True},
        {"tile": (256, 64), "compression": "deflate", "bigtiff": True},
    ],
    ids=str,
)
def test_tiff_of_any_layout(tmp_path: Path, pixels: np.ndarray, options: dict) -> None:
    photometric = "rgb" if pixels.ndim == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric=photometric, **options)
    assert_reads(tmp_path / "a.tif", pixels)


@pytest.mark.parametrize("pixels", [COLOR, MONO16, DEPTH], ids=["color", "mono16", "depth"])
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_zarr_array(tmp_path: Path, pixels: np.ndarray, zarr_format: int) -> None:
    chunks = (37, 20, *pixels.shape[2:])
    zarr.create_array(tmp_path / "a", data=pixels, chunks=chunks, zarr_format=zarr_format)
    assert_reads(tmp_path / "a", pixels)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
def test_folder_of_frames_in_natural_order(tmp_path: Path, suffix: str) -> None:
    write = {"png": imagecodecs.png_encode, "bmp": imagecodecs.bmp_encode}
    for number, start in ((8, 0), (9, 100), (10, 130)):
        frame = COLOR[start : {0: 100, 100: 130, 130: 300}[start]]
        file = tmp_path / f"frame{number}.{suffix}"
        if suffix == "tif":
            tifffile.imwrite(file, frame, photometric="rgb")
        else:
            file.write_bytes(write[suffix](frame))
    (tmp_path / "notes.txt").touch()
    assert_reads(tmp_path, COLOR)


@pytest.mark.parametrize(
    "names",
    [
        ["7.png", "8.png", "9.png", "10.png"],
        ["f_0.png", "f_300.png", "f_600.png"],  # by their first lines
        ["0311T1200_f01.PNG", "0311T1207_f02.png", "0312T0001_f03.png"],
        ["cam2_1.png", "cam2_2.png"],
    ],
)
def test_frames_that_are_numbered_without_a_gap(tmp_path: Path, names: list[str]) -> None:
    frames(*names)(tmp_path / "image")
    assert open_line_image(tmp_path / "image").shape == (300 * len(names), 48, 3)


def test_a_float_map_has_no_chunks_where_nothing_was_measured(tmp_path: Path) -> None:
    array = zarr.create_array(tmp_path / "a", shape=(300, 48), chunks=(100, 48), dtype="f4", fill_value=np.nan)
    array[:100] = 800.0
    image = open_line_image(tmp_path / "a")
    assert image.read(100, 300).isnan().all()


def test_mono_frames_of_16_bit(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(MONO16))
    assert_reads(tmp_path, MONO16)


def test_alpha_is_dropped(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.dstack([COLOR, COLOR[..., :1]]), photometric="rgb", extrasamples=[2])
    assert_reads(tmp_path / "a.tif", COLOR)


def test_each_band_is_decoded_once_when_reading_onwards_with_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []

    class Counted:
        path, layout, dtype = Path("counted"), (1000, 4, 1), np.dtype(np.uint8)
        edges = np.arange(0, 1001, 50)

        def decode(self, band: int) -> np.ndarray:
            decoded.append(band)
            return np.full((50, 4, 1), band, np.uint8)

    monkeypatch.setattr("lsvision.io.images.bands._CACHE_BYTES", 4 * 200)
    image = BandedImage(Counted())
    for start in range(0, 1000, 100):
        image.read(max(0, start - 80), min(1000, start + 180))
    assert decoded == list(range(20))
    image.read(0, 1)
    assert decoded[-1] == 0  # long forgotten: memory stays bounded


@pytest.mark.parametrize("kind", ["tiff", "zarr", "frames"])
def test_pickles_as_its_path(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "image"
    if kind == "tiff":
        tifffile.imwrite(path, COLOR, photometric="rgb", compression="zlib")
    elif kind == "zarr":
        zarr.create_array(path, data=COLOR, chunks=(100, 48, 3))
    else:
        path.mkdir()
        (path / "a.png").write_bytes(imagecodecs.png_encode(COLOR))
    image = open_line_image(path)
    image.read(0, 300)
    pickled = pickle.dumps(image)
    assert len(pickled) < 1000
    assert torch.equal(pickle.loads(pickled).read(10, 20), image.read(10, 20))


@pytest.mark.parametrize(("start", "stop"), [(-1, 3), (3, 2), (0, 301)])
def test_range_outside_the_image(tmp_path: Path, start: int, stop: int) -> None:
    tifffile.imwrite(tmp_path / "a.tif", MONO16)
    with pytest.raises(ValueError, match=r"within 0..300"):
        open_line_image(tmp_path / "a.tif").read(start, stop)


def several_pages(file: Path) -> None:
    tifffile.imwrite(file, np.zeros((3, 20, 16), np.uint8), photometric="minisblack")


def separate_planes(file: Path) -> None:
    tifffile.imwrite(file, np.zeros((3, 20, 16), np.uint8), photometric="rgb", planarconfig="separate")


def inverted(file: Path) -> None:
    tifffile.imwrite(file, np.zeros((20, 16), np.uint8), photometric="miniswhite")


def two_channels(file: Path) -> None:
    tifffile.imwrite(file, np.zeros((20, 16, 2), np.uint8), photometric="minisblack", planarconfig="contig")


def double_numbers(file: Path) -> None:
    tifffile.imwrite(file, np.zeros((20, 16)))


def text(file: Path) -> None:
    file.write_text("not an image")


def header_only(file: Path) -> None:
    file.write_bytes(b"II*\0")


def empty_folder(file: Path) -> None:
    file.mkdir()


def zarr_group(file: Path) -> None:
    zarr.open_group(file, mode="w")


def zarr_of_four_dimensions(file: Path) -> None:
    zarr.create_array(file, data=np.zeros((2, 2, 2, 2), np.uint8))


def frames_of_two_widths(file: Path) -> None:
    file.mkdir()
    (file / "1.png").write_bytes(imagecodecs.png_encode(COLOR))
    (file / "2.png").write_bytes(imagecodecs.png_encode(COLOR[:, 1:].copy()))


def frames(*names: str) -> Callable[[Path], None]:
    """Makes a folder of equal frames; those that end in .jpg are not read."""

    def make(file: Path) -> None:
        file.mkdir()
        for name in names:
            (file / name).write_bytes(imagecodecs.png_encode(COLOR))

    return make


def zarr_without_a_chunk(file: Path) -> None:
    zarr.create_array(file, data=COLOR, chunks=(100, 48, 3), zarr_format=2)
    (file / "1.0.0").unlink()


def turned(file: Path) -> None:
    tifffile.imwrite(file, COLOR, photometric="rgb", extratags=[(274, "H", 1, 3, True)])


def frame_that_is_text(file: Path) -> None:
    file.mkdir()
    (file / "1.png").write_text("no image")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (several_pages, "expected a TIFF of one page, got 3"),
        (separate_planes, "separate colour planes"),
        (inverted, "grey or RGB image, got MINISWHITE"),
        (two_channels, "1 or 3 channels .* got 2"),
        (double_numbers, "expected uint8, uint16 or float32, got float64"),
        (text, "expected a TIFF, a Zarr array or a folder of frames"),
        (header_only, "not a readable TIFF"),
        (empty_folder, "expected a Zarr array, or frames"),
        (zarr_group, "not a readable Zarr array"),
        (zarr_of_four_dimensions, "expected an array"),
        (frames_of_two_widths, "2.png: expected 48 columns as 1.png has, got 47"),
        (frames("f_1.png", "f_2.png", "f_4.png", "f_9.png"), r"frames 3, 5-8 are missing \(f_1.png to f_9.png\)"),
        (frames("f_1.png", "f_3.png"), "frames 2 are missing"),
        (frames("f_1.png", "f_01.png", "f_2.png"), "frames with equal numbers"),
        (frames("f_1.png", "f_2.jpg", "f_3.png"), "f_2.jpg: expected frames of one kind only, as f_1.png is"),
        (frames("f_1.png", "f_2.png", "f_3.bmp"), "expected frames of one kind only"),
        (frames("f_1.png", "F_2.png"), "expected frames whose names differ in a number only"),
        (frames("a.png", "b.png"), "expected frames whose names differ in a number only"),
        (frames("f_0.5.png", "f_1.0.png", "f_1.5.png"), "expected frames that are numbered one by one"),
        (zarr_without_a_chunk, "1 of 3 chunks are missing"),
        (turned, "expected the first line at the top .* got orientation 3"),
        (frame_that_is_text, "1.png: expected a PNG, BMP or TIFF"),
        (lambda file: None, "no such image"),
    ],
)
def test_what_is_not_a_line_image(tmp_path: Path, make: Callable[[Path], None], message: str) -> None:
    make(tmp_path / "image")
    with pytest.raises(FileFormatError, match=message):
        open_line_image(tmp_path / "image")


@pytest.mark.parametrize("options", [{}, {"compression": "zlib", "rowsperstrip": 64}, {"tile": (16, 16)}], ids=str)
@pytest.mark.parametrize("share", [0.01, 0.5, 0.98])
def test_tiff_cut_short(tmp_path: Path, options: dict, share: float) -> None:
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, COLOR, photometric="rgb", **options)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    with pytest.raises(FileFormatError, match=r"cut short|not a readable TIFF"):
        open_line_image(file)


def test_damaged_strip_names_its_lines(tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, COLOR, photometric="rgb", compression="zlib", rowsperstrip=64)
    with tifffile.TiffFile(file) as tiff:
        offset = tiff.pages.first.dataoffsets[1]
    data = bytearray(file.read_bytes())
    data[offset : offset + 40] = bytes(40)
    file.write_bytes(data)
    image = open_line_image(file)
    image.read(0, 64)
    with pytest.raises(FileFormatError, match="lines 64-127 cannot be decoded"):
        image.read(60, 70)


@pytest.mark.parametrize(("suffix", "kept"), [("png", 20), ("png", 30), ("bmp", 10), ("bmp", 20)])
def test_frame_with_a_damaged_header(tmp_path: Path, suffix: str, kept: int) -> None:
    encode = {"png": imagecodecs.png_encode, "bmp": imagecodecs.bmp_encode}[suffix]
    (tmp_path / f"1.{suffix}").write_bytes(encode(COLOR))
    (tmp_path / f"2.{suffix}").write_bytes(encode(COLOR)[:kept])
    with pytest.raises(FileFormatError, match=rf"2\.{suffix}: not a readable image: [^\n]*$"):
        open_line_image(tmp_path)


def png_header(lines: int, width: int) -> bytes:
    """The start of a PNG of bytes, up to its first pixels."""
    parts = []
    for kind, data in ((b"IHDR", struct.pack(">IIBBBBB", width, lines, 8, 0, 0, 0, 0)), (b"IDAT", b"")):
        parts.append(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_frames_of_any_size(tmp_path: Path) -> None:
    # Pillow's Image.open calls more than 179 million pixels an attack; a warning would fail the test as well.
    (tmp_path / "1.png").write_bytes(imagecodecs.png_encode(np.zeros((10, 7142), np.uint8)))
    (tmp_path / "2.png").write_bytes(png_header(30_000, 7142))
    image = open_line_image(tmp_path)
    assert image.shape == (30_010, 7142, 1)
    with pytest.raises(FileFormatError, match=r"2\.png: cannot be decoded"):
        image.read(10, 11)


def test_bmp_with_the_top_line_first(tmp_path: Path) -> None:
    data = bytearray(imagecodecs.bmp_encode(COLOR))
    data[22:26] = struct.pack("<i", -300)
    (tmp_path / "1.bmp").write_bytes(data)
    assert open_line_image(tmp_path).shape == (300, 48, 3)


def test_damaged_frame(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(imagecodecs.png_encode(COLOR))
    (tmp_path / "2.png").write_bytes(imagecodecs.png_encode(COLOR)[:2000])
    (tmp_path / "3.png").write_bytes(imagecodecs.png_encode(COLOR[..., 0].copy()))
    image = open_line_image(tmp_path)
    image.read(0, 300)
    with pytest.raises(FileFormatError, match=r"2\.png: cannot be decoded"):
        image.read(300, 301)
    with pytest.raises(FileFormatError, match=r"lines 600-899: expected \(300, 48, 3\) uint8"):
        image.read(600, 601)


@pytest.mark.parametrize("compression", ["zstd", "none"])
@pytest.mark.parametrize("pixels", [COLOR, MONO16, DEPTH], ids=["color", "mono16", "depth"])
@pytest.mark.parametrize("heights", [[300], [1, 255, 44], [256, 44], [299, 1], [100] * 3])
def test_written_strips_come_back_here_and_elsewhere(
    tmp_path: Path, pixels: np.ndarray, heights: list[int], compression: str
) -> None:
    whole = torch.from_numpy(pixels.reshape(300, 48, -1))
    file = tmp_path / "a.tif"
    write_line_image(file, whole.split(heights), tuple(whole.shape), whole.dtype, compression=compression)
    assert_reads(file, pixels)
    np.testing.assert_array_equal(tifffile.imread(file), pixels)
    with tifffile.TiffFile(file) as tiff:
        assert tiff.is_bigtiff
        assert tiff.pages.first.rowsperstrip == 256


@pytest.mark.parametrize(
    ("strips", "message"),
    [
        ([torch.zeros(255, 48, 3)], "uint8, got .* torch.float32"),
        ([torch.zeros(256, 47, 3, dtype=torch.uint8)], r"\(lines, 48, 3\) torch.uint8, got \(256, 47, 3\)"),
        ([torch.zeros(255, 48, 3, dtype=torch.uint8)], "expected 256 lines, got 255"),
        ([torch.zeros(256, 48, 3, dtype=torch.uint8)] * 2, "expected 256 lines, got more"),
        ([torch.zeros(257, 48, 3, dtype=torch.uint8)], "expected 256 lines, got more"),
    ],
)
def test_strips_that_do_not_fit_leave_nothing(tmp_path: Path, strips: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_line_image(tmp_path / "a.tif", strips, (256, 48, 3), torch.uint8)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("shape", "dtype"), [((9, 9, 2), torch.uint8), ((9, 9, 3), torch.int32)])
def test_images_that_no_camera_delivers(tmp_path: Path, shape: tuple, dtype: torch.dtype) -> None:
    with pytest.raises(ValueError, match="expected"):
        write_line_image(tmp_path / "a.tif", [], shape, dtype)
