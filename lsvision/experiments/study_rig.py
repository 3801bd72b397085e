"""``+experiment=study_rig``: how well a raw rig would be known from how many boards, scanned how."""

import logging
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

from lsvision.experiments.settings import RunSettings
from lsvision.io import write_json
from lsvision.io.formats.raw_rig import RawRigEntries
from lsvision.io.parquet import write_parquet
from lsvision.report.rig_study_pages import rig_study_report
from lsvision.schema import PositiveInt, Text
from lsvision.stages.rig.config import RigConfig, RigSigmas
from lsvision.stages.rig.model import RigPrior
from lsvision.study.grid import study_points
from lsvision.study.rig_runs import RigSampling, run_rigs
from lsvision.study.rig_scans import RigConditions
from lsvision.types import Board

log = logging.getLogger(__name__)


def axes_not_studied() -> dict[str, list[float | int] | None]:
    """Every condition, with no values to study."""
    return {item.name: None for item in fields(RigConditions)}


@dataclass(frozen=True, kw_only=True)
class StudyRigSettings(RunSettings):
    """Options of the experiment.

    ``data_sheet`` is the prior, with the sigmas of ``estimate``; the true rigs differ from it by those of ``drawn``,
    the same unless others are named: a calibration that expects other rigs than it gets cannot reach the bound.
    ``conditions`` are what every point has but for the ``axes``: lists of values by name
    of a condition, whose grid is studied. ``runs`` rigs are drawn and calibrated per point.
    """

    title: Text
    data_sheet: RawRigEntries
    board: Board
    estimate: RigConfig
    conditions: RigConditions
    drawn: RigSigmas = field(default_factory=RigSigmas)
    axes: dict[str, list[float | int] | None] = field(default_factory=axes_not_studied)
    runs: PositiveInt = 100


def run_study_rig(settings: StudyRigSettings, folder: Path) -> None:
    """Calibrate drawn rigs at every point; write the table, the summary and the report."""
    rig = settings.data_sheet.rig()
    prior, drawn = (RigPrior.of(rig, sigmas) for sigmas in (settings.estimate, settings.drawn))
    points = study_points(settings.conditions, settings.axes)
    sampling = RigSampling(settings.runs, settings.seed)
    table = run_rigs(points, prior, drawn, settings.board, settings.estimate, sampling)
    write_parquet(table, folder / "points.parquet")
    write_json(folder / "summary.json", {"points": table.to_dicts()})
    axes = [name for name, values in settings.axes.items() if values and len(values) > 1]
    rig_study_report(settings.title, table, axes, asdict(settings), folder)
    log.info("wrote %s and points.parquet beside it", folder / "report.html")
