"""The report of a motion from line to line."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lsvision.report.line_motion_figures import (
    LineMotionView,
    Profiles,
    component_name,
    in_shown_units,
    line_motion_figures,
    profiles_before_and_after,
)
from lsvision.report.line_motion_words import line_motion_words
from lsvision.report.pages import Headline, Page, Table, write_report


@dataclass(frozen=True)
class MeasuredMotion:
    """A motion that was measured: the scan's path, what was found as in a product's metadata, and what is drawn."""

    scan: str
    metadata: Mapping[str, Any]
    view: LineMotionView
    before: Profiles
    after: Profiles


def motion_report(measured: MeasuredMotion, settings: dict, folder: Path) -> None:
    """``report.html``: what moved, how well it is known, and the profile with and without it."""
    components = measured.metadata["components"]
    page = Page(
        title=f"Motion from line to line of {Path(measured.scan).name}",
        lead=". ".join(line.strip() for line in line_motion_words(measured.metadata)),
        headlines=[_headline(component) for component in components],
        tables=[findings_table(measured.metadata, settings["registration"])],
        figures=[
            *line_motion_figures(measured.view),
            *([profiles_before_and_after(measured.before, measured.after)] if len(measured.before.q_x) > 1 else []),
        ],
        settings=settings,
        provenance={"scan": measured.scan},
    )
    write_report(page, folder)


def findings_table(metadata: Mapping[str, Any], registration: Mapping[str, Any]) -> Table:
    """A row for every component: state, rms, sigma, length, gate, and what that means.

    Args:
        registration: the options that it was measured with.
    """
    header = ("component", "state", "rms", "sigma, rms", "changes over", "log evidence", "in words")
    note = (
        "Log evidence is how much better the lines fit with the component than without. One of which it is below "
        f"{registration['evidence']:g}, or which is less than {registration['least_ratio']:g} times the errors of a "
        "line, counts as absent. One that neither the object's shape nor its edges show is not observed."
    )
    return Table("Components", header, [_row(item) for item in metadata.get("components", ())], note)


def _headline(component: Mapping[str, Any]) -> Headline:
    name, state = component_name(component["component"]), component["state"]
    if state != "corrected":
        return Headline(name, state, component["in_words"].partition(": ")[2])
    rms, sigma = (in_shown_units(component["component"], component[key], "%.3g") for key in ("rms", "sigma"))
    return Headline(name, rms, f"rms, known to {sigma}")


def _row(component: Mapping[str, Any]) -> tuple[str, ...]:
    name, length = component["component"], component["length_mm"]
    corrected = component["state"] == "corrected"
    return (
        component_name(name),
        component["state"],
        in_shown_units(name, component["rms"], "%.3g") if corrected else "",
        in_shown_units(name, component["sigma"], "%.2g") if component["sigma"] else "",
        "" if length is None else f"{length:.3g} mm",
        f"{component['evidence']:.1f}",
        component["in_words"],
    )
