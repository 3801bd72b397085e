"""The HTML report: one file that needs nothing else, with its figures beside it as PNG and SVG."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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

    Axes in three dimensions are embedded as views from all round, to be turned in the page.
    """

    name: str
    title: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Table:
    """A table of a report; cells are shown as they are, the first of a row as a link where ``links`` has one for it."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    links: Sequence[str] = ()


@dataclass(frozen=True)
class Comparison:
    """A headline figure: what it is, its value with unit, and what it is held against."""

    label: str
    value: str
    against: str = ""


@dataclass(frozen=True)
class _Shown:
    """A figure as the page shows it."""

    item: ReportFigure
    embedded: Embedded


def write_report(
    folder: Path,
    *,
    title: str,
    lead: str,
    headlines: Sequence[Comparison],
    tables: Sequence[Table],
    figures: Sequence[ReportFigure],
    settings: dict,
    provenance: Mapping[str, str] | None = None,
) -> None:
    """Write ``report.html`` and ``figures/*.png, *.svg`` into a run's folder.

    Args:
        lead: one paragraph that says what was done and what came out.
        settings: the resolved configuration, shown at the end.
        provenance: what the results were made from, by name, beside the versions that made them.
    """
    pictures = folder / "figures"
    pictures.mkdir(parents=True, exist_ok=True)
    shown = [_Shown(item, embed(item.figure, pictures / item.name)) for item in figures]
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
        provenance={**(provenance or {}), **_versions()},
    )
    write_text(folder / "report.html", page)


def _versions() -> dict[str, str]:
    return {
        "lsvision": __version__,
        "torch": str(torch.__version__),
        "Python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
