"""``+experiment=inspect``: the product's ``surface``, its tables, the report; faults in one line."""

import json

import pytest
import torch
import zarr

from lsvision.io import ProductLayout, product_writer, read_product, read_surface
from lsvision.types import ProductStrip
from tests.stages.surface.products import dented, rail


@pytest.fixture
def product(tmp_path):
    """A product of a rail with a dent and a bump."""
    memory = dented(dented(rail(600), 50.0, 0.0, 3.0, 0.3), 90.0, 10.0, 3.0, -0.3)
    layout = ProductLayout(memory.grid, 1, torch.uint8, 512, {"scan": "rail"})
    valid = memory.heights.isfinite()
    source = torch.zeros(*valid.shape, 2)
    with product_writer(tmp_path / "rail.zarr", layout) as rows:
        for start in (0, 512):
            part = slice(start, start + 512)
            rows.write(ProductStrip(start, memory.colors[part], memory.heights[part], valid[part], source[part]))
    return tmp_path / "rail.zarr"


@pytest.mark.drawn
def test_all_that_it_writes(product, command, tmp_path, capsys):
    import polars

    assert command("+experiment=inspect", f"product={product}", "surface.smoothing_mm=0.6") == 0
    assert "surface of 120 mm" in capsys.readouterr().out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["candidates"] == {"dent": 1, "bump": 1}
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "1 dent, 1 bump" in page
    figures = {path.name for path in (tmp_path / "run" / "figures").glob("*.png")}
    assert figures == {"surface_map.png", "candidates.png", "surface_profile.png"}

    table = polars.read_parquet(product / "surface" / "defects.parquet").sort("along_mm")
    assert table["kind"].to_list() == ["dent", "bump"]
    assert table["along_mm"].to_list() == pytest.approx([50.0, 90.0], abs=0.1)
    assert polars.read_csv(product / "surface" / "defects.csv").shape == table.shape
    shapes = json.loads((product / "surface" / "defects.geojson").read_text())
    ring = torch.tensor(shapes["features"][0]["geometry"]["coordinates"][0])
    nearest = table.filter(polars.col("kind") == shapes["features"][0]["properties"]["kind"])
    assert ring.mean(0)[1] == pytest.approx(nearest["along_mm"][0], abs=0.3)

    surface = read_surface(read_product(product))
    assert surface.grid.rows == 600
    assert surface.deviation(0, 600).shape == surface.sigma(0, 600).shape == surface.color(0, 600).shape[:2]
    assert surface.grid.origin_x_mm < 0 < surface.grid.origin_x_mm + surface.grid.columns * surface.grid.pitch_mm
    assert read_product(product).shape == (600, 300)  # as before


def test_a_second_inspection_replaces_the_first(product, command):
    sizes = []
    for depth in (0.03, 0.5):
        assert command("+experiment=inspect", f"product={product}", f"surface.least_depth_mm={depth}") == 0
        sizes.append((product / "surface" / "defects.csv").read_text().count("\n"))
    assert sizes == [3, 1]
    assert not list(product.glob("*.partial*"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["product=nowhere"], "nowhere"),
        (["surface.low_sigma=20"], "low_sigma: expected at most high_sigma"),
        (["surface.smoothing_mm=0"], "surface.smoothing_mm"),
    ],
)
def test_faults_are_one_line(options, said, product, command, capsys):
    given = options if options[0].startswith("product") else [f"product={product}", *options]
    assert command("+experiment=inspect", *given) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_product_without_a_profile_is_one_line_and_stays_as_it_was(product, command, capsys):
    height = zarr.open_array(product / "height" / "0", mode="r+")
    height[:] = float("nan")
    assert command("+experiment=inspect", f"product={product}") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no profile" in line
    assert not (product / "surface").exists()


def test_wear_against_a_section_is_stated(product, command, tmp_path, capsys):
    assert command("+experiment=inspect", f"product={product}", "surface.reference=EN60E1") == 0
    assert "section EN60E1: " in capsys.readouterr().out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert [round(piece["last_mm"] - piece["first_mm"]) for piece in summary["wear"]] == [120]
    assert (product / "surface" / "wear.csv").read_text().count("\n") == 2
    assert "Wear" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


def test_a_section_that_is_not_there_is_one_line(product, command, capsys):
    assert command("+experiment=inspect", f"product={product}", "surface.reference=none.csv") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "none.csv" in line
