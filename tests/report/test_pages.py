"""The report: one HTML file that asks for nothing else, its text escaped, its figures beside it."""

import base64
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from lsvision.io import ProductLayout, ProductWriter, read_product
from lsvision.report import Comparison, ReportFigure, Table, calibration_report, product_report, write_report
from lsvision.report.drawing import label_axes, new_figure

NASTY = "<script>alert('x')</script> & \"quotes\""


class Page(HTMLParser):
    """Collects what a page refers to and what it says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.references += [value for key, value in attributes if key in ("src", "href", "srcset", "data", "poster")]

    def handle_data(self, data):
        self.text += data


def read_page(folder: Path) -> Page:
    source = (folder / "report.html").read_text(encoding="utf-8")
    assert "http:" not in source
    assert "https:" not in source
    assert "@import" not in source
    assert "url(" not in source
    page = Page(source)
    assert all(reference.startswith("data:") for reference in page.references)
    return page


@pytest.fixture
def figure() -> ReportFigure:
    drawing, (axes,) = new_figure(2, 2)
    label_axes(axes, "line", "x [mm]", "y [mm]")
    axes.plot([0, 1], [1, 2])
    return ReportFigure("line", f"title {NASTY}", f"caption {NASTY}", drawing)


def test_report_is_complete_and_escaped(tmp_path, figure):
    write_report(
        tmp_path,
        title=f"title {NASTY}",
        lead=f"lead {NASTY}",
        headlines=[Comparison("RMSE", f"1 {NASTY}", "before: 2 mm")],
        tables=[Table("Boards", ("scan", "σ [mm]"), [(NASTY, "0.5"), ("Tür", "0.1")], note="a note")],
        figures=[figure],
        settings={"scan": NASTY, "nested": {"list": [1, 2]}, "path": None},
    )
    page = read_page(tmp_path)
    assert page.tags.count("script") == 1  # the page's own
    for piece in (f"title {NASTY}", f"lead {NASTY}", f"1 {NASTY}", f"caption {NASTY}", "σ [mm]", "Tür", "a note"):
        assert piece in page.text
    assert page.tags.count("tr") == 3
    assert "nested:" in page.text
    png, svg = tmp_path / "figures" / "line.png", tmp_path / "figures" / "line.svg"
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "<svg" in svg.read_text(encoding="utf-8")
    (picture,) = [r for r in page.references if r.startswith("data:image/png;base64,")]
    assert base64.b64decode(picture.split(",", 1)[1]) == png.read_bytes()


def test_report_without_figures_or_tables(tmp_path):
    write_report(tmp_path, title="t", lead="l", headlines=[], tables=[], figures=[], settings={})
    page = read_page(tmp_path)
    assert "img" not in page.tags
    assert "table" not in page.tags


def test_calibration_report(tmp_path, determined, corners):
    calibration_report(determined, [corners], {"method": "joint"}, tmp_path)
    page = read_page(tmp_path)
    assert page.tags.count("img") == 5
    assert "Calibration from 1 board scan(s)" in page.text
    assert "<first> & last" in page.text
    assert "determined" in page.text
    assert "1.020427" in page.text
    assert "± 4.0e-05 mm per mm" in page.text
    assert len(list((tmp_path / "figures").glob("*.png"))) == len(list((tmp_path / "figures").glob("*.svg"))) == 5


@pytest.mark.parametrize("measured", [True, False])
def test_product_report(tmp_path, measured):
    height = torch.full((20, 30), 2.5) if measured else torch.full((20, 30), torch.nan)
    target = tmp_path / "scan.zarr"
    layout = ProductLayout((20, 30), 0.5, (1.0, 2.0), 3, torch.uint8, chunk_rows=20, metadata={"scan": NASTY})
    with ProductWriter(target, layout) as writer:
        color = torch.randint(0, 256, (20, 30, 3)).to(torch.uint8)
        writer.write(0, color, height, height.isfinite(), torch.zeros(20, 30, 2))
    product_report(read_product(target), 0.5, {"pitch": 0.5}, tmp_path)
    page = read_page(tmp_path)
    assert NASTY in page.text
    assert "20 x 30 cells" in page.text
    assert "50.0 %" in page.text
    assert ("2.50 .. 2.50 mm" if measured else "nothing measured") in page.text
