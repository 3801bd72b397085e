"""``+experiment=study``: how good a calibration would be, by Monte Carlo through the library's own calibration."""

import logging
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import polars

from lsvision.experiments.settings import RunSettings
from lsvision.io import write_json
from lsvision.io.parquet import write_parquet
from lsvision.report import Study, study_report
from lsvision.schema import IntFrom2, Positive, PositiveInt, Text
from lsvision.simulation import BoardPose
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.study.grid import study_points
from lsvision.study.map import tilt_map
from lsvision.study.points import Conditions, exact_corners
from lsvision.study.runs import Sampling, run_points
from lsvision.study.tables import iterations_table, points_table, runs_table
from lsvision.types import Board, Rig

log = logging.getLogger(__name__)

_SLOWEST = ("boards", "method")


def axes_not_studied() -> dict[str, list[float | int | str] | None]:
    """Every condition, with no values to study; the boards and the method vary slowest."""
    return dict.fromkeys(sorted((item.name for item in fields(Conditions)), key=lambda name: name not in _SLOWEST))


@dataclass(frozen=True, kw_only=True)
class StudySettings(RunSettings):
    """Options of the experiment.

    ``placings`` are sets of board poses by name, ``conditions`` what every point has but for the ``axes``: lists of
    values by name of a condition, whose grid is studied; None leaves a condition as it is. ``runs`` calibrations are
    made per point, ``batch`` at a time; the batch changes the speed and the memory, not the result. ``calibration``
    holds what the conditions do not.
    """

    title: Text
    rig: Rig
    board: Board
    placings: dict[str, list[BoardPose]]
    conditions: Conditions
    calibration: CalibrationConfig
    axes: dict[str, list[float | int | str] | None] = field(default_factory=axes_not_studied)
    runs: PositiveInt = 500
    batch: PositiveInt = 256
    map_range_deg: Positive = 15.0
    map_steps: IntFrom2 = 21


def run_study(settings: StudySettings, folder: Path) -> None:
    """Calibrate every point many times, write the tables, the summary and the report."""
    points = study_points(settings.conditions, settings.axes)
    corners = [exact_corners(settings.rig, settings.board, settings.placings, point) for point in points]
    log.info("%d points of %d calibrations each", len(points), settings.runs)
    sampling = Sampling(settings.runs, settings.batch, settings.seed, settings.threads)
    results = run_points(points, corners, settings.calibration, sampling)
    runs = runs_table(points, corners, results)
    study = Study(
        title=settings.title,
        axes=tuple(name for name, values in settings.axes.items() if values and len(values) > 1),
        runs=runs,
        points=points_table(points, corners, runs),
        iterations=iterations_table(results),
        tilts=tilt_map(settings.rig, settings.board, points[0], settings.map_range_deg, settings.map_steps),
    )
    for name in ("runs", "points", "iterations"):
        write_parquet(getattr(study, name), folder / f"{name}.parquet")
    write_json(folder / "summary.json", _summary(study))
    study_report(study, asdict(settings), folder)
    log.info("wrote %s and runs, points and iterations as Parquet beside it", folder / "report.html")


def _summary(study: Study) -> dict:
    """Plain values: the study's size, the medians of its figures of merit, and those of each point."""
    merits = ("rms_n1", "rms_n2", "rms_n3", "error_over_bound", "nees", "rmse_after_mm", "converged", "prior_dominated")
    return {
        "points": len(study.points),
        "calibrations": len(study.runs),
        "median": study.points.select(polars.col(merits).median()).row(0, named=True),
        "results": study.points.select(*study.axes, *merits).to_dicts(),
    }
