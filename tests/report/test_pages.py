"""The report: one HTML file that loads nothing else, its text escaped, its figures beside it."""

import base64
import dataclasses
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from lsvision.io import ProductLayout, product_writer, read_product
from lsvision.report import Headline, Page, ReportFigure, Table, calibration_report, product_report, write_report
from lsvision.report.drawing import label_axes, new_figure
from lsvision.stages.installation.config import InstallationConfig
from lsvision.stages.installation.guide import Transported, installation_guide
from lsvision.types import ProductGrid, ProductStrip, Provenance

NASTY = "<script>alert('x')</script> & \"quotes\""


class ReadPage(HTMLParser):
    """Collects the references, tags and text of a page."""

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


def read_page(folder: Path) -> ReadPage:
    source = (folder / "report.html").read_text(encoding="utf-8")
    assert "http:" not in source
    assert "https:" not in source
    assert "@import" not in source
    assert "url(" not in source
    page = ReadPage(source)
    assert all(reference.startswith("data:") for reference in page.references)
    return page


@pytest.fixture
def figure() -> ReportFigure:
    drawing, (axes,) = new_figure(2, 2)
    label_axes(axes, "line", "x [mm]", "y [mm]")
    axes.plot([0, 1], [1, 2])
    return ReportFigure("line", f"title {NASTY}", f"caption {NASTY}", drawing)


def test_report_is_complete_and_escaped(tmp_path, figure):
    page = Page(
        title=f"title {NASTY}",
        lead=f"lead {NASTY}",
        headlines=[Headline("RMSE", f"1 {NASTY}", "before: 2 mm")],
        tables=[Table("Boards", ("scan", "σ [mm]"), [(NASTY, "0.5"), ("Tür", "0.1")], note="a note")],
        figures=[figure],
        settings={"scan": NASTY, "nested": {"list": [1, 2]}, "path": None},
        provenance={"scans/a": f"sha256 {NASTY}"},
    )
    write_report(page, tmp_path)
    page = read_page(tmp_path)
    assert page.tags.count("script") == 1  # that of the template
    for piece in (f"title {NASTY}", f"lead {NASTY}", f"1 {NASTY}", f"caption {NASTY}", "σ [mm]", "Tür", "a note"):
        assert piece in page.text
    assert f"sha256 {NASTY}" in page.text
    assert page.tags.count("tr") == 3 + 5  # the table's, and what it was made from
    assert "nested:" in page.text
    png, svg = tmp_path / "figures" / "line.png", tmp_path / "figures" / "line.svg"
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "<svg" in svg.read_text(encoding="utf-8")
    (picture,) = [r for r in page.references if r.startswith("data:image/svg+xml;base64,")]
    assert base64.b64decode(picture.split(",", 1)[1]) == svg.read_bytes()


def test_rows_link_to_pages_beside_the_report(tmp_path):
    table = Table("Jobs", ("job", "n"), [("0", "1"), (NASTY, "2")], links=["0/report.html", "1/report.html"])
    write_report(Page(title="t", lead="l", headlines=[], tables=[table]), tmp_path)
    page = ReadPage((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.references[1:] == ["0/report.html", "1/report.html"]
    assert NASTY in page.text


def test_report_without_figures_or_tables(tmp_path):
    write_report(Page(title="t", lead="l", headlines=[]), tmp_path)
    page = read_page(tmp_path)
    assert "img" not in page.tags
    assert page.tags.count("table") == 1  # what it was made from
    assert "torch" in page.text


def test_calibration_report(tmp_path, determined, corners):
    determined = dataclasses.replace(
        determined, provenance=Provenance("0.1.0", "abc", (("scans/<first>", "def"), ("scans/second", "123")))
    )
    calibration_report(determined, [corners, corners], {"method": "joint"}, tmp_path)
    page = read_page(tmp_path)
    assert page.tags.count("img") == 6 + 18  # six drawings, and the boards from all round
    assert page.tags.count("input") == 1
    assert "sha256 abc" in page.text
    assert "sha256 123" in page.text
    assert "Calibration from 2 board scan(s)" in page.text
    assert "<first> & last" in page.text
    assert "determined" in page.text
    assert "1.020427" in page.text
    assert "± 4.0e-05 mm per mm" in page.text
    assert len(list((tmp_path / "figures").glob("*.png"))) == len(list((tmp_path / "figures").glob("*.svg"))) == 7


@pytest.mark.usefixtures("quick_reports")
def test_calibrations_without_a_guide_have_no_sketch(tmp_path, dominated, corners):
    calibration_report(dominated, [corners, corners], {}, tmp_path)
    assert "Align the cameras" not in (tmp_path / "report.html").read_text()


@pytest.mark.usefixtures("quick_reports")
def test_calibrations_with_a_guide_say_what_to_turn(tmp_path, determined, corners):
    guide = installation_guide(determined.motion, 0.05, Transported(0.07), InstallationConfig())
    calibration_report(dataclasses.replace(determined, installation=guide), [corners, corners], {}, tmp_path)
    page = read_page(tmp_path)
    assert "the end at the larger columns moves to where the object comes from (+1.46" in page.text
    assert (tmp_path / "figures" / "installation.png").exists()


@pytest.mark.drawn
@pytest.mark.usefixtures("quick_reports")
@pytest.mark.parametrize("measured", [True, False])
def test_product_report(tmp_path, measured, dominated):
    height = torch.full((20, 30), 2.5) if measured else torch.full((20, 30), torch.nan)
    target = tmp_path / "scan.zarr"
    layout = ProductLayout(ProductGrid(20, 30, 0.5, 1.0, 2.0), 3, torch.uint8, chunk_rows=20, metadata={"scan": NASTY})
    with product_writer(target, layout) as writer:
        color = torch.randint(0, 256, (20, 30, 3)).to(torch.uint8)
        writer.write(ProductStrip(0, color, height, height.isfinite(), torch.zeros(20, 30, 2)))
    product_report(read_product(target), dominated, 0.5, {"pitch": 0.5}, tmp_path)
    page = read_page(tmp_path)
    assert NASTY in page.text
    assert "20 x 30 cells" in page.text
    assert "50.0 %" in page.text
    assert "not converged" in page.text
    assert "-25.490 mm/m" in page.text
    assert ("2.50 .. 2.50 mm" if measured else "nothing measured") in page.text
