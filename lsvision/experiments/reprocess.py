"""``+experiment=reprocess``: every scan of an archive -> products, a ledger of them, and a report."""

import logging
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from lsvision.archive import (
    LEDGER_FILE,
    WORK_FOLDER,
    Engine,
    EngineConfig,
    Ledger,
    LineMotionChoice,
    LocalEngine,
    Outcome,
    Place,
    Plan,
    PlannedScan,
    Processing,
    ScanRow,
    Task,
    alarms,
    damaged_products,
    find_scans,
    gather_surfaces,
    health_in_words,
    is_worked_on,
    ledger_lines,
    local_archive,
    plan_run,
    predicted_bytes,
    predicted_seconds,
    process_scans,
    product_rows,
    read_calibrations,
    sole_run,
    worker_count,
)
from lsvision.errors import ConfigError, ScansFailedError
from lsvision.experiments.settings import RunSettings
from lsvision.report.archive_pages import Run, reprocess_report
from lsvision.report.progress import progress_bars
from lsvision.report.surface_words import surfaces_in_words
from lsvision.schema import PositiveInt, Text
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.health.config import HealthConfig
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import MissingLines, RefusedVerdict

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReprocessSettings(RunSettings):
    """Options of the experiment; products lie below ``output`` as their scans do below ``archive``.

    ``line_motion`` is ``none``, a file for all scans, or ``auto``: a scan's own log, else what its profile shows by
    ``registration``.
    A calibration without a usable n is refused, unless ``accept`` has its verdict. ``health`` is when a drift of the
    scans is an alarm. With ``inspect`` the surface of every product is inspected by ``surface``, and the candidates of
    all are one table, ``defects.parquet``.
    """

    archive: Text
    calibration: Text
    output: Text
    engine: EngineConfig
    disparity: DisparityConfig
    correction: CorrectionConfig
    dry_run: bool = False
    verify: bool = False
    repair_encoder: bool = False
    missing_lines: MissingLines = "refuse"
    line_motion: Text = "auto"
    registration: LineMotionConfig = field(default_factory=LineMotionConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    inspect: bool = False
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    accept: list[RefusedVerdict] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class StatusSettings(RunSettings):
    """Options of ``+experiment=status``."""

    output: Text
    health: HealthConfig = field(default_factory=HealthConfig)
    threads: PositiveInt = 1


def run_reprocess(settings: ReprocessSettings, folder: Path) -> None:
    """Find, plan, process, report.

    Raises:
        ScansFailedError: some scans failed; the others are done.
    """
    output = Path(settings.output).absolute()
    if settings.dry_run:
        known, seconds_per_line = _read_ledger(output)
        _log_plan(_plan(settings, output, known), seconds_per_line, settings.engine)
        return
    with sole_run(output), Ledger(output / LEDGER_FILE) as ledger:
        plan = _plan(settings, output, ledger.scans())
        _log_plan(plan, ledger.seconds_per_line(), settings.engine)
        begin = time.perf_counter()
        processing = _processing(settings)
        place = Place(ledger, output, output / WORK_FOLDER, processing, verify=settings.verify, watch=True)
        try:
            processed = _process(settings, plan, place)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_done_so_far(plan, ledger)) from None
        for found, problem in plan.faulty.items():
            ledger.put_scan(ScanRow(found.key, str(found.path), "failed", error=problem))
        seconds = time.perf_counter() - begin
        keys = {scan.key for scan in (*plan.to_do, *plan.unchanged)} | {found.key for found in plan.faulty}
        rows = {key: row for key, row in ledger.scans().items() if key in keys}
        made = [key for key, row in rows.items() if row.status == "done"]
        surfaces = gather_surfaces(output, made) if settings.inspect else []
    failed = {key: row for key, row in rows.items() if row.status == "failed"}
    drifts = alarms(rows, settings.health)
    run = Run(output, seconds, asdict(settings), settings.health, drifts, surfaces)
    reprocess_report(rows, processed, run, folder)
    for line in ledger_lines(failed):
        log.info("%s", line)
    for drift in drifts:
        log.warning("drift: %s", drift.in_words)
    if surfaces:
        log.info("%s", surfaces_in_words(surfaces))
    done = sum(row.status == "done" for row in processed)
    log.info("%d done, %d unchanged, %d failed, in %.1f s", done, len(rows) - done - len(failed), len(failed), seconds)
    if failed:
        raise ScansFailedError(len(failed), len(rows), str(output / LEDGER_FILE))


def run_status(settings: StatusSettings, folder: Path) -> None:
    """Print the ledger of an output."""
    output = Path(settings.output)
    rows, _ = _read_ledger(output)
    if not rows:
        raise ConfigError(f"output: no ledger in {settings.output}")
    if not is_worked_on(output):
        rows = {key: _at_rest(row) for key, row in rows.items()}
    for line in ledger_lines(rows):
        log.info("%s", line)
    drifts = alarms(rows, settings.health)
    for drift in drifts:
        log.warning("drift: %s", drift.in_words)
    log.info("%s", health_in_words(rows, drifts, settings.health))


def _at_rest(row: ScanRow) -> ScanRow:
    """A scan's row where no run is at work: one that was ended left its scans as running."""
    return replace(row, status="stopped") if row.status == "running" else row


def _done_so_far(plan: Plan, ledger: Ledger) -> str:
    rows = ledger.scans()
    done = sum(scan.key in rows and rows[scan.key].status == "done" for scan in plan.to_do)
    return f"{done} of {len(plan.to_do)} scans are done, and finished strips of others are kept"


def _plan(settings: ReprocessSettings, output: Path, known: Mapping[str, ScanRow]) -> Plan:
    calibrations = read_calibrations(settings.calibration, settings.accept)
    for calibration in calibrations:
        if calibration.accepted and calibration.warning:
            log.warning("%s", calibration.warning)
    found = find_scans(local_archive(settings.archive, output / WORK_FOLDER / "copies"), skip=output)
    if not found:
        raise ConfigError(f"archive: no scans in {settings.archive}")
    return plan_run(found, calibrations, _processing(settings), known, output)


def _processing(settings: ReprocessSettings) -> Processing:
    return Processing(
        settings.disparity,
        settings.correction,
        settings.repair_encoder,
        settings.engine.worker_memory_mb,
        settings.missing_lines,
        LineMotionChoice.of(settings.line_motion, settings.registration),
        surface=settings.surface if settings.inspect else None,
    )


def _read_ledger(output: Path) -> tuple[Mapping[str, ScanRow], Mapping[str, float]]:
    """Scans of a ledger and the mean time of a line in each stage; no ledger is created."""
    if not (output / LEDGER_FILE).is_file():
        return {}, {}
    with Ledger(output / LEDGER_FILE) as ledger:
        return ledger.scans(), ledger.seconds_per_line()


def _log_plan(plan: Plan, seconds_per_line: Mapping[str, float], engine: EngineConfig) -> None:
    """Log what was found before anything starts."""
    log.info(
        "%d scans to do with %d lines, %d unchanged, %d that cannot be read",
        len(plan.to_do), sum(scan.lines for scan in plan.to_do), len(plan.unchanged), len(plan.faulty),
    )  # fmt: skip
    for found, problem in plan.faulty.items():
        log.info("  %s: %s", found.key, problem)
    if plan.to_do:
        workers = worker_count(engine)
        log.info(
            "about %.0f s on %d workers, at most %.2f GB of products and depth",
            predicted_seconds(plan, seconds_per_line, workers), workers, predicted_bytes(plan) / 1e9,
        )  # fmt: skip


def _process(settings: ReprocessSettings, plan: Plan, place: Place) -> list[ScanRow]:
    """Process the planned scans, and those whose products turn out to be damaged where they are verified."""
    verified = plan.unchanged if settings.verify else []
    if not plan.to_do and not verified:
        return []
    with _engine(settings.engine) as engine:
        return _process_with(engine, [*plan.to_do, *damaged_products(verified, engine, place)], place)


def _process_with(engine: Engine, scans: list[PlannedScan], place: Place) -> list[ScanRow]:
    """Process scans under one bar over all their lines; a line counts when its row of the product is there."""
    lines_per_row = {scan.key: scan.lines / scan.grid.rows for scan in scans}
    with progress_bars() as bars:
        bar = bars.start("reprocess", total=sum(scan.lines for scan in scans))

        def advance(task: Task, outcome: Outcome) -> None:
            bars.advance(bar, product_rows(task, outcome) * lines_per_row[task.scan])

        return process_scans(scans, engine, place, advance)


def _engine(config: EngineConfig) -> Engine:
    if config.kind == "local":
        return LocalEngine(worker_count(config))
    try:
        from lsvision.archive.engines.dask import DaskEngine
    except ModuleNotFoundError as error:
        raise ConfigError(f"engine=dask needs the extra 'cluster': pip install 'lsvision[cluster]' ({error})") from None
    engine = DaskEngine(config.scheduler, worker_count(config), config.worker_memory_mb, config.tls)
    log.info("dashboard: %s", engine.dashboard)
    if config.scheduler is not None and config.tls is None:
        log.info(
            "whoever reaches %s can run programs there: for trusted networks, or set engine.tls_authority",
            config.scheduler,
        )
    return engine
