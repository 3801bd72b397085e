"""Report of a study."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars

from lsvision.estimation import mean_chi_square_band
from lsvision.report.pages import Comparison, ReportFigure, Table, write_report
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

# Columns of the points that follow from the boards' placing, and are studied with it.
_OF_PLACING = ("board_count", "tilt_spread_deg")
_MOST_ROWS = 60


@dataclass(frozen=True)
class Study:
    """What a study found: a row a run, a point and an iteration, the names of what was varied, and the map of tilts."""

    title: str
    axes: tuple[str, ...]
    runs: polars.DataFrame
    points: polars.DataFrame
    iterations: polars.DataFrame
    tilts: TiltMap


def study_report(study: Study, settings: dict, folder: Path) -> None:
    """``report.html`` of a study: its size and outcome, every figure its axes allow, the table of points."""
    points = study.points
    per_point = int(points["runs"][0])
    determined = points.filter(polars.col("prior_dominated") < 0.5)
    finished = determined.filter(polars.col("converged") > 0.5)
    write_report(
        folder,
        title=study.title,
        lead=(
            f"{len(study.runs)} calibrations of simulated corners, {per_point} at each of {len(points)} points, "
            "through the calibration that real scans go through. The error is held against the Cramér-Rao bound, the "
            "least that any estimate could make of the same corners."
        ),
        headlines=[
            Comparison("Determined", f"{len(determined)} of {len(points)} points", "the others repeat the prior on n"),
            Comparison(
                "Error over bound", _median(finished, "error_over_bound"), "where determined and converged; 1 is best"
            ),
            Comparison("Converged", _share(points, "converged"), "of all calibrations"),
            Comparison("Failed", _share(points, "failed"), "of all calibrations"),
        ],
        tables=[_points_table(study)],
        figures=_figures(study, per_point),
        settings=settings,
    )


def _figures(study: Study, per_point: int) -> list[ReportFigure]:
    points, axes = study.points, study.axes
    varied = [name for name in axes if name in AXIS_LABELS]
    derived = [name for name in _OF_PLACING if "boards" in axes and points[name].n_unique() > 1]
    figures = []
    if "boards" in axes:
        figures.append(placings(points))
    if "angle_z_deg" in axes:
        figures.append(truth_and_estimate(study.runs, points, _without(axes, "angle_z_deg")))
    figures += [accuracy(points, name, _without(axes, name)) for name in varied]
    figures += [accuracy(points, name, _without(axes, "boards")) for name in derived]
    return [
        *figures,
        convergence(study.iterations, points, tuple(name for name in axes if name in ("method", "boards")) or axes),
        tilt_map(study.tilts),
        consistency(points.filter(polars.col("prior_dominated") < 0.5), mean_chi_square_band(3, per_point)),
    ]


def _points_table(study: Study) -> Table:
    header = (
        *(AXIS_LABELS.get(name, name) for name in study.axes),
        "corners", "rms error of n1, n2, n3 [mm per mm]", "claimed σ", "error over bound", "NEES (3)",
        "RMSE before [mm]", "after [mm]", "iterations", "converged", "prior-dominated",
    )  # fmt: skip
    rows = [
        (
            *(_cell(row[name]) for name in study.axes),
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
    left_out = len(study.points) - len(rows)
    note = f"{left_out} more points are in points.parquet." if left_out else "points.parquet has every column."
    note += " Where the prior dominates, the error is that of the prior, whatever the bound."
    return Table("Points of the study", header, rows, note)


def _median(points: polars.DataFrame, name: str) -> str:
    return f"{np.median(points[name].to_numpy()):.3f}" if len(points) else "none"


def _share(points: polars.DataFrame, name: str) -> str:
    return f"{100 * points[name].to_numpy().mean():.1f} %"


def _cell(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _without(names: tuple[str, ...], *left_out: str) -> tuple[str, ...]:
    return tuple(name for name in names if name not in left_out)
