"""Levels of the pyramid: by hand, in strips as at once, and under the NGFF 0.5 schema."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import zarr

from lsvision.errors import FileFormatError
from lsvision.io import ProductLayout, ProductRows, check_product, create_product, product_writer, read_product
from lsvision.io.product.pyramid import halve, level_count, level_shape
from lsvision.types import ProductGrid, ProductStrip

ROWS, COLUMNS = 1100, 1030
GRID = ProductGrid(ROWS, COLUMNS, 0.28, -3.5, 120.25)
LAYOUT = ProductLayout(GRID, 3, torch.uint8, 256, {"scan": "A"}, uncertainty=True)


def planes() -> list[torch.Tensor]:
    color = torch.randint(0, 256, (ROWS, COLUMNS, 3)).to(torch.uint8)
    valid = torch.rand(ROWS, COLUMNS) < 0.8
    height = torch.randn(ROWS, COLUMNS).masked_fill(~valid, torch.nan)
    return [color, height, valid, torch.rand(ROWS, COLUMNS, 2), torch.rand(ROWS, COLUMNS, 3)]


@pytest.fixture(scope="module")
def product(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path, written = tmp_path_factory.mktemp("pyramid") / "a.zarr", planes()
    with product_writer(path, LAYOUT) as writer:
        for row in range(0, ROWS, 256):
            writer.write(ProductStrip(row, *(plane[row : row + 256] for plane in written)))
    return path


def test_levels_by_hand() -> None:
    assert [level_count(shape, 512) for shape in ((70, 12), (510, 9000), (512, 9000), (10**6, 7676))] == [1, 1, 2, 5]
    assert level_count((10**6, 7676), 100) == 3
    assert [level_shape((1100, 1030), level) for level in range(4)] == [
        (1100, 1030),
        (550, 515),
        (275, 258),
        (138, 129),
    ]


def test_halving_by_hand() -> None:
    color = torch.tensor([[0, 100, 7], [20, 80, 9], [3, 5, 11]], dtype=torch.uint8)[..., None]
    assert halve(color, average=True)[..., 0].tolist() == [[50, 8], [4, 11]]
    heights = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [torch.nan, 8.0, 9.0]])
    np.testing.assert_array_equal(halve(heights, average=False), [[1.0, 3.0], [torch.nan, 9.0]])
    wide = torch.tensor([[65535, 65535], [65535, 65531]], dtype=torch.uint16)[..., None]
    assert halve(wide, average=True).tolist() == [[[65534]]]


def test_every_level_is_half_the_one_before(product: Path) -> None:
    root = zarr.open_group(product, mode="r")
    for name in ("height", "valid", "source", "sigma"):
        fine, coarse, coarsest = (root[f"{name}/{level}"][...] for level in range(3))
        np.testing.assert_array_equal(fine[..., ::2, ::2], coarse)
        np.testing.assert_array_equal(coarse[..., ::2, ::2], coarsest)
    fine, coarse = (root[f"color/{level}"][...].astype(float) for level in range(2))
    mean = (fine[:, ::2, ::2] + fine[:, 1::2, ::2] + fine[:, ::2, 1::2] + fine[:, 1::2, 1::2]) / 4
    assert np.abs(coarse - mean).max() <= 0.5


def test_chunks_of_strips_are_never_shared(product: Path) -> None:
    root = zarr.open_group(product, mode="r")
    assert [root[f"height/{level}"].chunks for level in range(3)] == [(256, 1030), (128, 515), (64, 258)]
    with pytest.raises(ValueError, match=r"whole groups of 4 rows, got 2\.\.6"):
        ProductRows(product).write(ProductStrip(2, *(plane[2:6] for plane in planes())))


def test_sigma_is_written_where_it_was_planned(product: Path, tmp_path: Path) -> None:
    assert read_product(product).has_sigma
    assert read_product(product).sigma(3, 9).shape == (6, COLUMNS, 3)
    with pytest.raises(ValueError, match="sigma: the product needs it"):
        ProductRows(product).write(ProductStrip(0, *(plane[:4] for plane in planes()[:4])))
    rows = create_product(tmp_path, ProductLayout(ProductGrid(8, 9, 1.0, 0.0, 0.0), 3, torch.uint8, 8, {}))
    with pytest.raises(ValueError, match="sigma: the product has none"):
        rows.write(ProductStrip(0, *(plane[:8, :9] for plane in planes())))


@pytest.mark.parametrize("name", ["color", "height", "valid", "source", "sigma"])
def test_images_obey_the_schema_and_open_elsewhere(product: Path, name: str) -> None:
    import ome_zarr_models.v05  # here, as it takes a second

    # It checks the metadata against NGFF 0.5 and the arrays against the metadata.
    image = ome_zarr_models.v05.Image.from_zarr(zarr.open_group(product / name, mode="r"))
    (multiscale,) = image.ome_attributes.multiscales
    assert [dataset.path for dataset in multiscale.datasets] == ["0", "1", "2"]
    assert multiscale.axes[-1].unit == "millimeter"
    for level, dataset in enumerate(multiscale.datasets):
        scale, translation = dataset.coordinateTransformations
        assert scale.scale[-2:] == [0.28 * 2**level] * 2
        shift = 0.14 * (2**level - 1) if name == "color" else 0.0
        assert translation.translation[-2:] == pytest.approx([-3.5 + shift, 120.25 + shift])


def test_a_whole_product_passes(product: Path) -> None:
    check = check_product(product)
    assert (check.rows, check.columns, check.levels) == (ROWS, COLUMNS, 3)
    assert check.valid_share == pytest.approx(float(read_product(product).valid(0, ROWS).float().mean()))
    heights = read_product(product).height(0, ROWS)
    assert check.lowest_mm == float(heights[heights.isfinite()].min())
    assert check.highest_mm == float(heights[heights.isfinite()].max())


def flip_a_bit(product: Path) -> None:
    chunk = product / "color" / "1" / "c" / "0" / "2" / "0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)


def lose_a_chunk(product: Path) -> None:
    (product / "source" / "0" / "c" / "0" / "3" / "0").unlink()


def shorten_a_chunk(product: Path) -> None:
    chunk = product / "height" / "0" / "c" / "1" / "0"
    chunk.write_bytes(chunk.read_bytes()[:100])


def contradict(product: Path) -> None:
    zarr.open_array(product / "valid" / "0", mode="r+")[700, :] = False


def misplace(product: Path) -> None:
    file = product / "color" / "zarr.json"
    text = json.loads(file.read_text())
    text["attributes"]["ome"]["multiscales"][0]["datasets"][1]["coordinateTransformations"][0]["scale"][-1] = 0.3
    file.write_text(json.dumps(text))


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (flip_a_bit, "color/1: rows 256-383: damaged"),
        (lose_a_chunk, "source/0: 1 of 5 chunks are missing"),
        (shorten_a_chunk, "height/0: rows 256-511: damaged"),
        (contradict, "valid: rows 512-767: heights of cells that are invalid"),
        (misplace, r"color\.ome: the metadata do not describe"),
    ],
)
def test_every_fault_is_found_and_placed(
    product: Path, tmp_path: Path, harm: Callable[[Path], None], message: str
) -> None:
    harmed = tmp_path / "a.zarr"
    shutil.copytree(product, harmed)
    harm(harmed)
    with pytest.raises(FileFormatError, match=message):
        check_product(harmed)
