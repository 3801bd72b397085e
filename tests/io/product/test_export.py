"""Products in other programs' formats, read back by readers that are not ours."""

from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest
import tifffile
import torch

from lsvision.errors import FileFormatError
from lsvision.io import Product, ProductLayout, export_product, product_writer, read_product
from lsvision.types import ProductGrid, ProductStrip

ROWS, COLUMNS, PITCH, DATUM = 300, 40, 0.25, 796.9
ORIGIN_Y, ORIGIN_X = 1000.0, -80.0


def write(path: Path, *, dtype: torch.dtype = torch.uint8, channels: int = 3, metadata: dict | None = None) -> Product:
    color = torch.randint(0, 255, (ROWS, COLUMNS, channels)).to(dtype) * (257 if dtype == torch.uint16 else 1)
    valid = torch.rand(ROWS, COLUMNS) < 0.7
    height = (20 * torch.randn(ROWS, COLUMNS)).masked_fill(~valid, torch.nan)
    metadata = {"zero_disparity_mm": 1.0, "height_datum_mm": DATUM} if metadata is None else metadata
    layout = ProductLayout(ProductGrid(ROWS, COLUMNS, PITCH, ORIGIN_Y, ORIGIN_X), channels, dtype, 512, metadata)
    with product_writer(path, layout) as writer:
        writer.write(ProductStrip(0, color, height, valid, torch.zeros(ROWS, COLUMNS, 2)))
    return read_product(path)


def true_points(product: Product) -> tuple[np.ndarray, np.ndarray]:
    """(q_x, q_y, q_z) in mm and colours of all valid cells, row by row."""
    height, color = product.height(0, ROWS).double().numpy(), product.color(0, ROWS).numpy()
    row, column = np.nonzero(np.isfinite(height))
    points = np.stack([ORIGIN_X + PITCH * column, ORIGIN_Y + PITCH * row, DATUM - height[row, column]], axis=-1)
    return points, color[row, column]


def test_ply_in_plyfile(tmp_path: Path) -> None:
    product = write(tmp_path / "a.zarr")
    (file,) = export_product(product, "ply", tmp_path / "a")
    vertices = plyfile.PlyData.read(file)["vertex"]
    points, colors = true_points(product)
    np.testing.assert_allclose(np.stack([vertices[name] for name in "xyz"], -1), points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(np.stack([vertices[name] for name in ("red", "green", "blue")], -1), colors)


@pytest.mark.parametrize(("dtype", "channels"), [(torch.uint8, 3), (torch.uint16, 1)])
def test_laz_in_laspy(tmp_path: Path, dtype: torch.dtype, channels: int) -> None:
    product = write(tmp_path / "a.zarr", dtype=dtype, channels=channels)
    (file,) = export_product(product, "laz", tmp_path / "a")
    assert file.name == "a.laz"
    cloud = laspy.read(file)
    points, colors = true_points(product)
    assert cloud.header.are_points_compressed
    assert np.abs(np.stack([cloud.x, cloud.y, cloud.z], -1) - points).max() <= 0.5e-3 + 1e-9
    colors = colors * np.uint16(257) if dtype == torch.uint8 else np.repeat(colors, 3, axis=1)
    np.testing.assert_array_equal(np.stack([cloud.red, cloud.green, cloud.blue], -1), colors)
    np.testing.assert_allclose(cloud.header.mins, points.min(0), atol=0.5e-3 + 1e-9)


def test_tiff_in_tifffile(tmp_path: Path) -> None:
    product = write(tmp_path / "a.v1.zarr")
    color, height = export_product(product, "tiff", tmp_path / "a.v1")
    assert (color.name, height.name) == ("a.v1_color.tif", "a.v1_height.tif")
    np.testing.assert_array_equal(tifffile.imread(color), product.color(0, ROWS).numpy())
    np.testing.assert_array_equal(tifffile.imread(height), product.height(0, ROWS).numpy())
    with tifffile.TiffFile(height) as file:
        assert file.is_bigtiff


def test_older_products_count_heights_from_their_zero_disparity(tmp_path: Path) -> None:
    product = write(tmp_path / "a.zarr", metadata={"zero_disparity_mm": DATUM})
    (file,) = export_product(product, "ply", tmp_path / "a")
    vertices, (points, _) = plyfile.PlyData.read(file)["vertex"], true_points(product)
    np.testing.assert_allclose(vertices["z"], points[:, 2], rtol=0, atol=1e-9)


def test_a_product_without_its_depth_makes_no_points(tmp_path: Path) -> None:
    product = write(tmp_path / "a.zarr", metadata={})
    with pytest.raises(FileFormatError, match=r"a\.zarr: lsvision\.height_datum_mm: expected a number"):
        export_product(product, "ply", tmp_path / "a")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
