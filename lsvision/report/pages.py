"""The HTML report: one file that needs nothing else, with its figures beside it as PNG and SVG."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from lsvision import __version__
from lsvision.io import write_text
from lsvision.report.embedding import Embedded, embed


@dataclass(frozen=True)
class ReportFigure:
    """A figure with its file name, title and a caption that says what to see.

    A figure in three dimensions is embedded as a ring of views, which the reader turns with a slider.
    """

    name: str
    title: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Table:
    """A table of a report, with text in its cells; the first cell of row i links to ``links[i]`` if links are given."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    links: Sequence[str] = ()


@dataclass(frozen=True)
class Headline:
    """A headline figure: its name, its value with unit, and what to compare it with or how to read it."""

    label: str
    value: str
    context: str = ""


@dataclass(frozen=True)
class Page:
    """Everything a report shows.

    Attributes:
        title: of the page.
        lead: one paragraph that says what was done and what the result is.
        headlines, tables, figures: in the order of the page.
        settings: the resolved configuration, shown at the end.
        provenance: names and hashes of what the results were made from.
    """

    title: str
    lead: str
    headlines: Sequence[Headline]
    tables: Sequence[Table] = ()
    figures: Sequence[ReportFigure] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Shown:
    """A figure as the page shows it."""

    item: ReportFigure
    embedded: Embedded


def write_report(page: Page, folder: Path) -> None:
    """Write ``report.html`` and ``figures/*.png, *.svg`` into a run's folder."""
    pictures = folder / "figures"
    pictures.mkdir(parents=True, exist_ok=True)
    shown = [_Shown(item, embed(item.figure, pictures / item.name)) for item in page.figures]
    environment = Environment(
        loader=PackageLoader("lsvision.report"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    html = environment.get_template("report.html.j2").render(
        page=page,
        figures=shown,
        settings=yaml.safe_dump(dict(page.settings), sort_keys=False, allow_unicode=True),
        provenance={**page.provenance, **_versions()},
    )
    write_text(folder / "report.html", html)


def cell_text(value: object, digits: int = 6) -> str:
    """Text of a table's cell: floats to a number of significant digits, nothing for None."""
    if value is None:
        return ""
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def _versions() -> dict[str, str]:
    return {
        "lsvision": __version__,
        "torch": str(torch.__version__),
        "Python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
