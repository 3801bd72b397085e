"""Tiles are the cells of the product, at every level of deep zoom; sections are its values."""

import cv2
import numpy as np
import pytest

from lsvision.errors import LsvisionError
from lsvision.io import read_product
from lsvision.viewer.layers import TILE
from lsvision.viewer.product_view import ProductView
from tests.viewer.products import write_rail


@pytest.fixture(scope="module")
def view(tmp_path_factory):
    return ProductView.of(write_rail(tmp_path_factory.mktemp("view") / "rail.zarr"))


def decoded(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(("column", "row"), [(0, 0), (1, 2), (2, 4)])
def test_a_tile_of_the_highest_level_is_the_cells_themselves(view, column, row):
    layer = view.layers["color"]
    tile = decoded(layer.tile(layer.top, column, row))
    expected = view.product.color(row * TILE, min((row + 1) * TILE, 1200))[:, column * TILE : (column + 1) * TILE]
    assert np.array_equal(tile[..., 2::-1], expected.numpy())
    assert (tile[..., 3] == 255).all()


def test_levels_halve_down_to_a_single_tile_and_beyond_the_pyramid(view):
    layer = view.layers["color"]
    assert layer.top == 11  # 2 ** 11 >= 1200
    sizes = [decoded(layer.tile(level, 0, 0)).shape[:2] for level in range(layer.top, 4, -1)]
    assert sizes == [(256, 256), (256, 256), (256, 150), (150, 75), (75, 38), (38, 19), (19, 10)]
    half = decoded(layer.tile(layer.top - 1, 0, 0))[..., 2::-1].astype(int)
    full = view.product.color(0, 512)[:, :512].float().reshape(256, 2, 256, 2, 3).mean((1, 3)).numpy()
    assert abs(half - full).max() <= 1


def test_what_was_not_measured_is_transparent_and_colours_follow_the_range(view):
    layer = view.layers["deviation"]
    column = layer.grid.columns // 2 // TILE
    tile = decoded(layer.tile(layer.top, column, 0, (-0.1, 0.1)))
    values = layer.values(range(tile.shape[0]), range(column * TILE, column * TILE + tile.shape[1]))
    assert np.array_equal(tile[..., 3] > 0, np.isfinite(values))
    inwards, outwards = values < -0.05, values > 0.008
    assert (tile[inwards][:, 2] > tile[inwards][:, 0]).all()  # red over blue
    assert (tile[outwards][:, 0] > tile[outwards][:, 2]).all()


@pytest.mark.parametrize(("level", "column", "row"), [(12, 0, 0), (11, 3, 0), (11, 0, 5), (-1, 0, 0)])
def test_a_tile_that_is_not_there_is_an_error(view, level, column, row):
    with pytest.raises(LsvisionError, match=r"level|tile"):
        view.layers["color"].tile(level, column, row)


def test_sections_are_the_product_s_values(view):
    section = view.section("height", 640, 300)
    heights = read_product(view.product.path).height(0, 1200)
    across = np.array([np.nan if value is None else value for value in section["across"]["values"]])
    assert np.allclose(across, heights[640].numpy(), atol=1e-4, equal_nan=True)
    assert section["across"]["first_mm"] == pytest.approx(view.product.grid.origin_x_mm)
    assert len(section["along"]["values"]) == 1025
    assert section["along"]["first_mm"] == pytest.approx(view.product.grid.q_y(128))
    assert section["value"] == pytest.approx(float(heights[640, 300]), abs=1e-4)
    for name, row, column in (("color", 0, 0), ("none", 0, 0), ("height", 1200, 0), ("height", 0, 600)):
        with pytest.raises(LsvisionError):
            view.section(name, row, column)


def test_the_page_knows_layers_and_candidates(view, tmp_path):
    info = view.info
    assert [layer["name"] for layer in info["layers"]] == ["color", "height", "surface_color", "deviation"]
    (candidate,) = info["candidates"]
    assert candidate["along_mm"] == pytest.approx(50.0, abs=0.1)
    assert view.layers["height"].span[0] > -20  # the rail, not the ground
    plain = ProductView.of(write_rail(tmp_path / "plain.zarr", inspected=False)).info
    assert [layer["name"] for layer in plain["layers"]] == ["color", "height"]
    assert plain["candidates"] == []
