"""Images without some of their frames or chunks, opened with ``missing_lines="mark"``."""

import pickle
from collections.abc import Sequence
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
import zarr

from lsvision.errors import FileFormatError
from lsvision.image.brightness import sampled_lines
from lsvision.io import open_line_image
from lsvision.types import LineImage, TensorImage, missing_ranges

PIXELS = np.random.default_rng(1).integers(1, 256, (100, 16, 3), dtype=np.uint8)


def frames(folder: Path, heights: dict[str, int]) -> Path:
    """A folder of frames with the first lines of ``PIXELS``."""
    folder.mkdir()
    for name, lines in heights.items():
        (folder / name).write_bytes(imagecodecs.png_encode(PIXELS[:lines]))
    return folder


def assert_lacks(image: LineImage, ranges: Sequence[range], lines: int) -> None:
    assert image.shape == (lines, 16, 3)
    assert missing_ranges(image) == tuple(ranges)
    assert missing_ranges(pickle.loads(pickle.dumps(image))) == tuple(ranges)
    pixels, there = image.read(0, lines), torch.ones(lines, dtype=torch.bool)
    for part in ranges:
        there[part.start : part.stop] = False
    assert (pixels[there] > 0).all()
    assert (pixels[~there] == 0).all()


@pytest.mark.parametrize(
    ("heights", "ranges", "lines"),
    [
        ({"1.png": 10, "2.png": 10, "4.png": 10, "7.png": 6}, [range(20, 30), range(40, 60)], 66),
        ({"f_0.png": 10, "f_10.png": 10, "f_40.png": 10}, [range(20, 40)], 50),  # by their first lines
        ({"f_9.png": 10, "f_10.png": 10, "f_20.png": 10, "f_21.png": 10}, None, 0),  # nine of four that are there
        ({"f_1.png": 10, "f_2.png": 10, "f_3.png": 10}, [], 30),
        ({"cam2_01.png": 10, "cam2_03.png": 4}, [range(10, 20)], 24),
    ],
)
def test_missing_frames(tmp_path, heights, ranges, lines):
    folder = frames(tmp_path / "image", heights)
    if ranges is None:
        with pytest.raises(FileFormatError, match="9 frames are missing, more than the 4 that are there"):
            open_line_image(folder, "mark")
        return
    assert_lacks(open_line_image(folder, "mark"), ranges, lines)
    if ranges:
        with pytest.raises(FileFormatError, match=r"frames .* are missing"):
            open_line_image(folder)


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        ({"1.png": 10, "2.png": 9, "4.png": 10}, "those that are there differ in height"),
        ({"1.png": 10, "3.png": 10, "4.png": 11}, "those that are there differ in height"),
        ({"1.png": 10, "01.png": 10, "3.png": 10}, "frames .* are missing"),  # two with number 1
        ({"t10_1.png": 10, "t25_2.png": 10, "t30_4.png": 10}, "numbered one by one"),  # which of the two counts?
        ({"a.png": 10, "b_1.png": 10}, "differ in a number only"),
    ],
)
def test_frames_of_which_it_is_unclear_how_many_are_missing(tmp_path, heights, message):
    with pytest.raises(FileFormatError, match=message):
        open_line_image(frames(tmp_path / "image", heights), "mark")


def test_a_missing_frame_of_depths_was_not_measured(tmp_path):
    for number in (1, 3):
        tifffile.imwrite(tmp_path / f"{number}.tif", np.full((10, 16), 800.0, np.float32))
    z = open_line_image(tmp_path, "mark").read(0, 30)[..., 0]
    assert z.isnan().any(1).nonzero()[:, 0].tolist() == list(range(10, 20))


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_missing_chunks(tmp_path, zarr_format):
    """A line counts as missing where any of its chunks is; columns 0-7 of lines 90-99 are there."""
    zarr.create_array(tmp_path / "a", data=PIXELS, chunks=(30, 8, 3), zarr_format=zarr_format)
    for place in ((0, 0), (0, 1), (1, 0), (1, 1), (3, 1)):
        (tmp_path / "a" / {2: "{}.{}.0", 3: "c/{}/{}/0"}[zarr_format].format(*place)).unlink()
    with pytest.raises(FileFormatError, match="5 of 8 chunks are missing"):
        open_line_image(tmp_path / "a")
    image = open_line_image(tmp_path / "a", "mark")
    assert missing_ranges(image) == (range(60), range(90, 100))
    np.testing.assert_array_equal(image.read(60, 90), PIXELS[60:90])


def test_an_image_without_any_chunk(tmp_path):
    zarr.create_array(tmp_path / "a", shape=(100, 16), chunks=(30, 16), dtype="u1")
    with pytest.raises(FileFormatError, match="all 100 lines are missing"):
        open_line_image(tmp_path / "a", "mark")


def test_levels_are_read_from_lines_that_are_there(tmp_path):
    image = open_line_image(frames(tmp_path / "image", {"1.png": 10, "2.png": 10, "5.png": 10, "6.png": 2}), "mark")
    sampled = sampled_lines(image)
    assert (sampled > 0).all()
    assert torch.equal(sampled, sampled_lines(TensorImage(torch.cat([image.read(0, 20), image.read(40, 52)]))))
