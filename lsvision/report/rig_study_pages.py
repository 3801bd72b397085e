"""The report of a study of raw rigs."""

from collections.abc import Sequence
from pathlib import Path

import polars

from lsvision.report.drawing import AFTER, BEFORE, label_axes, new_figure
from lsvision.report.pages import Headline, Page, ReportFigure, Table, write_report

_MERITS = {
    "height_error_um": "heights off by [um]",
    "stated_um": "as stated [um]",
    "over_bound": "over the Cramér-Rao bound",
    "nees": "NEES",
    "within_3_sigma": "errors within 3 sigma",
    "largest_z": "largest error [sigma]",
    "converged": "converged",
}


def rig_study_report(title: str, points: polars.DataFrame, axes: Sequence[str], settings: dict, folder: Path) -> None:
    """``report.html`` of a study: errors of heights and the consistency of what is stated, point by point.

    Args:
        points: as ``run_rigs`` gives them. axes: names of the varied conditions.
    """
    unknowns, band, runs = points["unknowns"][0], points["nees_band"][0], points["runs"][0]
    heights, nees, converged = (points[name].to_numpy() for name in ("height_error_um", "nees", "converged"))
    page = Page(
        title=title,
        lead=(
            f"{runs} rigs, off their data sheet, at each of {len(points)} points, calibrated by the code that "
            "calibrates real ones. Heights: rms over the field, but for the pose of the object."
        ),
        headlines=[
            Headline("Heights", f"{heights.min():.2g} to {heights.max():.2g} um", "rms error over the points"),
            Headline(
                "NEES", f"{nees.mean():.1f}", f"mean over the points; of each {unknowns:.0f} ± {band:.1f} is right"
            ),
            Headline("Converged", f"{100 * converged.mean():.0f} %", "of all calibrations"),
        ],
        tables=[_table(points, axes)],
        figures=[_heights(points, axes)],
        settings=settings,
        provenance={},
    )
    write_report(page, folder)


def _table(points: polars.DataFrame, axes: Sequence[str]) -> Table:
    rows = [
        (*(f"{row[axis]:g}" for axis in axes), *(f"{row[name]:.3g}" for name in _MERITS))
        for row in points.iter_rows(named=True)
    ]
    return Table("Points", (*axes, *_MERITS.values()), rows, "Errors of heights and what the calibrations say of them.")


def _heights(points: polars.DataFrame, axes: Sequence[str]) -> ReportFigure:
    """Errors of heights, as they are and as stated, over the first axis."""
    figure, (panel,) = new_figure(7.5, 4.2)
    axis = axes[0] if axes else "boards"
    panel.loglog(points[axis], points["height_error_um"], "o", color=AFTER, label="error")
    panel.loglog(points[axis], points["stated_um"], "_", ms=14, color=BEFORE, label="as stated")
    panel.loglog(points[axis], points["bound_um"], "x", ms=5, color="#555555", label="Cramér-Rao bound")
    label_axes(panel, "Heights of the field", axis.replace("_", " "), "rms error of heights [um]")
    figure.legend(loc="outside right upper", fontsize=9)
    caption = (
        "One mark is one point; where error and statement agree, a calibration says how good it is. "
        "On average over the rigs no calibration of the same scans is below the bound."
    )
    return ReportFigure("heights", "Heights", caption, figure)
