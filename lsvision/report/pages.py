"""The HTML report: one file that needs nothing else, with its figures beside it as PNG and SVG."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from lsvision import __version__
from lsvision.io import write_text

_DPI = 110


@dataclass(frozen=True)
class ReportFigure:
    """A figure with its file name, title and a caption that says what to see."""

    name: str
    title: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Table:
    """A table of a report; cells are shown as they are."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class Comparison:
    """A headline figure: what it is, its value with unit, and what it is held against."""

    label: str
    value: str
    against: str = ""


def write_report(
    folder: Path,
    *,
    title: str,
    lead: str,
    headlines: Sequence[Comparison],
    tables: Sequence[Table],
    figures: Sequence[ReportFigure],
    settings: dict,
) -> None:
    """Write ``report.html`` and ``figures/*.png, *.svg`` into a run's folder.

    Args:
        lead: one paragraph that says what was done and what came out.
        settings: the resolved configuration, shown at the end.
    """
    pictures = folder / "figures"
    pictures.mkdir(parents=True, exist_ok=True)
    shown = []
    for item in figures:
        png = _saved(item.figure, "png")
        (pictures / f"{item.name}.png").write_bytes(png)
        (pictures / f"{item.name}.svg").write_bytes(_saved(item.figure, "svg"))
        shown.append({"item": item, "data": base64.b64encode(png).decode()})
    environment = Environment(
        loader=PackageLoader("lsvision.report"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("report.html.j2").render(
        title=title,
        lead=lead,
        headlines=headlines,
        tables=tables,
        figures=shown,
        settings=yaml.safe_dump(settings, sort_keys=False, allow_unicode=True),
        version=__version__,
    )
    write_text(folder / "report.html", page)


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=_DPI, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()
