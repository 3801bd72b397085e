import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lsvision.errors import FileFormatError
from lsvision.io import ProductLayout, ProductRows, complete_product, create_product, product_writer, read_product
from lsvision.types import ProductGrid, ProductStrip

ROWS, COLUMNS = 70, 12
GRID_9 = ProductGrid(ROWS, COLUMNS, 9.0, -3.5, 120.25)
OPTIONS = {
    "grid": ProductGrid(ROWS, COLUMNS, 0.28, -3.5, 120.25),
    "channels": 3,
    "dtype": torch.uint8,
    "chunk_rows": 32,
    "metadata": {"scan": "A", "zero_disparity_mm": 796.9},
}


def planes(dtype: torch.dtype = torch.uint8, channels: int = 3) -> tuple[torch.Tensor, ...]:
    color = torch.randint(0, 256, (ROWS, COLUMNS, channels)).to(dtype)
    valid = torch.rand(ROWS, COLUMNS) < 0.8
    height = torch.randn(ROWS, COLUMNS).masked_fill(~valid, torch.nan)
    return color, height, valid, torch.rand(ROWS, COLUMNS, 2)


@pytest.mark.parametrize(("dtype", "channels"), [(torch.uint8, 3), (torch.uint16, 1)])
@pytest.mark.parametrize("blocks", [[(0, 70)], [(0, 32), (32, 64), (64, 70)], [(40, 70), (0, 5), (5, 40)]])
def test_blocks_come_back(tmp_path: Path, dtype: torch.dtype, channels: int, blocks: list) -> None:
    written = planes(dtype, channels)
    options = OPTIONS | {"dtype": dtype, "channels": channels}
    with product_writer(tmp_path / "a.zarr", ProductLayout(**options)) as writer:
        for start, stop in blocks:
            writer.write(ProductStrip(start, *(plane[start:stop] for plane in written)))
        assert not (tmp_path / "a.zarr").exists()
    product = read_product(tmp_path / "a.zarr")
    read = (product.color, product.height, product.valid, product.source)
    for start, stop in [(0, 70), (13, 50), (7, 7)]:
        for expected, plane in zip(written, read, strict=True):
            found = plane(start, stop)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found.numpy(), expected[start:stop].numpy())
        strip = product.read(start, stop)
        assert strip.row == start
        assert strip.sigma is None
        for expected, found in zip(written, (strip.color, strip.height, strip.valid, strip.source), strict=True):
            np.testing.assert_array_equal(found.numpy(), expected[start:stop].numpy())
    assert product.grid == OPTIONS["grid"]
    assert (product.shape, product.pitch_mm, product.origin_mm) == ((ROWS, COLUMNS), 0.28, (-3.5, 120.25))
    assert product.metadata == {"scan": "A", "zero_disparity_mm": 796.9, "format": "lsvision-product/1"}


def test_rows_never_written_are_invalid(tmp_path: Path) -> None:
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)):
        pass
    product = read_product(tmp_path / "a.zarr")
    assert not product.valid(0, ROWS).any()
    assert product.height(0, ROWS).isnan().all()
    assert product.source(0, ROWS).isnan().all()


def test_metadata_is_that_of_ome_zarr(tmp_path: Path) -> None:
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)):
        pass
    for name, dtype, leading in (("color", "uint8", 3), ("height", "float32", 0), ("valid", "bool", 0)):
        group = json.loads((tmp_path / "a.zarr" / name / "zarr.json").read_text())
        assert (group["zarr_format"], group["node_type"]) == (3, "group")
        ome = group["attributes"]["ome"]
        assert ome["version"] == "0.5"
        (image,) = ome["multiscales"]
        space = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "yx"]
        channel = [{"name": "c", "type": "channel"}] if leading else []
        assert image["axes"] == channel + space
        (level,) = image["datasets"]
        assert level["path"] == "0"
        assert level["coordinateTransformations"] == [
            {"type": "scale", "scale": [1.0] * len(channel) + [0.28, 0.28]},
            {"type": "translation", "translation": [0.0] * len(channel) + [-3.5, 120.25]},
        ]
        array = json.loads((tmp_path / "a.zarr" / name / "0" / "zarr.json").read_text())
        lead = [leading] if leading else []
        assert array["shape"] == [*lead, ROWS, COLUMNS]
        assert array["chunk_grid"]["configuration"]["chunk_shape"] == [*lead, 32, COLUMNS]
        assert array["data_type"] == dtype
        assert array["dimension_names"] == [axis["name"] for axis in image["axes"]]
        assert array["codecs"][-1]["name"] == "crc32c"


def break_off(writer: ProductRows) -> None:
    writer.write(ProductStrip(0, *planes()))
    raise ZeroDivisionError


def test_failure_leaves_nothing_or_the_earlier_product(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)) as writer:
        break_off(writer)
    assert not any(tmp_path.iterdir())
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)):
        pass
    with (
        pytest.raises(ZeroDivisionError),
        product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS | {"grid": GRID_9})),
    ):
        raise ZeroDivisionError
    assert read_product(tmp_path / "a.zarr").pitch_mm == 0.28
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS | {"grid": GRID_9})):
        pass
    assert read_product(tmp_path / "a.zarr").pitch_mm == 9.0


def test_failure_to_begin_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(KeyError),
        product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS | {"dtype": torch.int32})),
    ):
        pass
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("row", "change", "message"),
    [
        (-1, {}, r"row: expected a block within 0..70, got -1..69"),
        (1, {}, r"row: expected a block within 0..70, got 1..71"),
        (0, {0: torch.zeros(ROWS, COLUMNS, 3)}, "color: expected .* torch.uint8, got .* torch.float32"),
        (0, {1: torch.zeros(ROWS, COLUMNS + 1)}, r"height: expected \(70, 12\)"),
        (0, {2: torch.zeros(ROWS, COLUMNS)}, "valid: expected .* torch.bool"),
        (0, {3: torch.zeros(ROWS, COLUMNS, 3)}, r"source: expected \(70, 12, 2\)"),
    ],
)
def test_blocks_that_do_not_fit(tmp_path: Path, row: int, change: dict, message: str) -> None:
    blocks = [change.get(index, plane) for index, plane in enumerate(planes())]
    with (
        pytest.raises(ValueError, match=message),
        product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)) as writer,
    ):
        writer.write(ProductStrip(row, *blocks))


def test_what_is_not_a_product(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="not a readable product"):
        read_product(tmp_path / "nowhere")
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)):
        pass
    root = tmp_path / "a.zarr" / "zarr.json"
    root.write_text(root.read_text().replace("lsvision-product/1", "lsvision-product/7"))
    with pytest.raises(FileFormatError, match=r"a.zarr: lsvision.format: expected 'lsvision-product/1'"):
        read_product(tmp_path / "a.zarr")


def test_range_outside_the_grid(tmp_path: Path) -> None:
    with product_writer(tmp_path / "a.zarr", ProductLayout(**OPTIONS)):
        pass
    with pytest.raises(ValueError, match=r"within 0..70, got 60..71"):
        read_product(tmp_path / "a.zarr").height(60, 71)


def test_origin_and_pitch_are_exact(tmp_path: Path) -> None:
    origin = (1 / 3, -math.pi * 1e5)
    with product_writer(
        tmp_path / "a.zarr", ProductLayout(**OPTIONS | {"grid": ProductGrid(ROWS, COLUMNS, 0.1 + 0.2, *origin)})
    ):
        pass
    product = read_product(tmp_path / "a.zarr")
    assert (product.origin_mm, product.pitch_mm) == (origin, 0.1 + 0.2)


def test_rows_written_in_place_by_several_writers_make_the_same_product(tmp_path: Path) -> None:
    written = planes()
    layout = ProductLayout(**OPTIONS)
    create_product(tmp_path / "partial", layout)
    for start, stop in [(64, 70), (0, 32), (32, 64)]:
        ProductRows(tmp_path / "partial").write(ProductStrip(start, *(plane[start:stop] for plane in written)))
    complete_product(tmp_path / "partial", tmp_path / "a.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
    np.testing.assert_array_equal(read_product(tmp_path / "a.zarr").height(0, ROWS), written[1])


def test_rows_of_what_is_not_a_product(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="not a product to be written"):
        ProductRows(tmp_path)


def test_a_complete_product_takes_the_place_of_a_product_only(tmp_path: Path) -> None:
    create_product(tmp_path / "partial", ProductLayout(**OPTIONS))
    (tmp_path / "a.zarr").mkdir()
    (tmp_path / "a.zarr" / "notes.txt").write_text("keep")
    with pytest.raises(FileFormatError, match="to replace"):
        complete_product(tmp_path / "partial", tmp_path / "a.zarr")
    assert (tmp_path / "a.zarr" / "notes.txt").is_file()
