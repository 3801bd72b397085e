"""Report of a study."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars

from lsvision.estimation import mean_chi_square_band
from lsvision.report.pages import Headline, Page, ReportFigure, Table, cell_text, write_report
from lsvision.report.study_disturbances import DISTURBANCES, coverage, what_is_left
from lsvision.report.study_figures import (
    AXIS_LABELS,
    TiltMap,
    accuracy,
    consistency,
    convergence,
    placings,
    tilt_map,
    truth_and_estimate,
)

# Columns of the points that follow from the set of boards and are shown like a varied condition.
_OF_BOARDS = ("board_count", "tilt_spread_deg")
_MOST_ROWS = 60


@dataclass(frozen=True)
class Study:
    """The results of a study.

    Attributes:
        title: of the report.
        axes: names of the varied conditions.
        runs, points, iterations: tables with one row per calibration, per point and per iteration of a point.
        tilts: the map of tilts.
    """

    title: str
    axes: tuple[str, ...]
    runs: polars.DataFrame
    points: polars.DataFrame
    iterations: polars.DataFrame
    tilts: TiltMap

    @property
    def runs_per_point(self) -> int:
        """Number of calibrations of every point."""
        return int(self.points["runs"][0])

    @property
    def determined(self) -> polars.DataFrame:
        """Points at which most calibrations determine n."""
        return self.points.filter(polars.col("prior_dominated") < 0.5)

    def axes_without(self, name: str) -> tuple[str, ...]:
        """The varied conditions but one."""
        return tuple(axis for axis in self.axes if axis != name)


def study_report(study: Study, settings: dict, folder: Path) -> None:
    """``report.html`` of a study: its size and outcome, every figure that its axes allow, the table of points."""
    points, determined = study.points, study.determined
    finished = determined.filter(polars.col("converged") > 0.5)
    error = f"{np.median(finished['error_over_bound'].to_numpy()):.3f}" if len(finished) else "none"
    page = Page(
        title=study.title,
        lead=(
            f"{len(study.runs)} calibrations of simulated corners, {study.runs_per_point} at each of {len(points)} "
            "points, by the code that calibrates real scans. The error is compared with the Cramér-Rao bound, the "
            "smallest error that an unbiased estimate from the same corners can have."
        ),
        headlines=[
            Headline("Determined", f"{len(determined)} of {len(points)} points", "the others repeat the prior on n"),
            Headline("Error over bound", error, "median where determined and converged; 1 is best"),
            Headline("Converged", _share(points, "converged"), "of all calibrations"),
            Headline("Failed", _share(points, "failed"), "of all calibrations"),
        ],
        tables=[_points_table(study)],
        figures=_figures(study),
        settings=settings,
    )
    write_report(page, folder)


def _figures(study: Study) -> list[ReportFigure]:
    points, axes = study.points, study.axes
    figures = []
    if "boards" in axes:
        figures.append(placings(points))
    if "angle_z_deg" in axes:
        figures.append(truth_and_estimate(study.runs, points, study.axes_without("angle_z_deg")))
    figures += [accuracy(points, name, study.axes_without(name)) for name in axes if name in AXIS_LABELS]
    disturbances = [name for name in axes if name in DISTURBANCES]
    figures += [coverage(points, name, study.axes_without(name)) for name in disturbances]
    if "line_motion" in axes:
        figures += [what_is_left(points, name, study.axes_without(name)) for name in disturbances]
    if "boards" in axes:
        of_boards = [name for name in _OF_BOARDS if points[name].n_unique() > 1]
        figures += [accuracy(points, name, study.axes_without("boards")) for name in of_boards]
    methods = tuple(name for name in axes if name in ("method", "boards"))
    return [
        *figures,
        convergence(study.iterations, points, methods or axes),
        tilt_map(study.tilts),
        consistency(study.determined, mean_chi_square_band(3, study.runs_per_point)),
    ]


def _points_table(study: Study) -> Table:
    header = (
        *(AXIS_LABELS.get(name, name) for name in study.axes),
        "corners", "rms error of n1, n2, n3 [mm per mm]", "stated σ [mm per mm]", "error over bound",
        "NEES (3 is right)", "RMSE before [mm]", "after [mm]", "iterations", "converged", "prior-dominated",
    )  # fmt: skip
    rows = [
        (
            *(cell_text(row[name]) for name in study.axes),
            str(row["corners"]),
            "  ".join(f"{row[f'rms_n{k}']:.1e}" for k in (1, 2, 3)),
            "  ".join(f"{row[f'sigma_n{k}']:.1e}" for k in (1, 2, 3)),
            f"{row['error_over_bound']:.3f}" if row["prior_dominated"] < 0.5 else "–",
            f"{row['nees']:.2f}",
            f"{row['rmse_before_mm']:.4f}",
            f"{row['rmse_after_mm']:.4f}",
            f"{row['iterations_used']:.1f}",
            f"{100 * row['converged']:.0f} %",
            f"{100 * row['prior_dominated']:.0f} %",
        )
        for row in study.points.head(_MOST_ROWS).iter_rows(named=True)
    ]
    omitted = len(study.points) - len(rows)
    note = f"{omitted} more points are in points.parquet." if omitted else "points.parquet has every column."
    note += " Where the prior dominates, the error is that of the prior, however small the bound."
    return Table("Points of the study", header, rows, note)


def _share(points: polars.DataFrame, name: str) -> str:
    return f"{100 * points[name].to_numpy().mean():.1f} %"
