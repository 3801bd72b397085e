"""``+experiment=reprocess``: every scan of an archive -> products, a ledger of them, and a report."""

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from lsvision.archive import (
    LEDGER_FILE,
    Engine,
    EngineConfig,
    Ledger,
    LocalEngine,
    Place,
    Plan,
    Processing,
    ScanRow,
    find_scans,
    ledger_lines,
    local_archive,
    plan_run,
    predicted_bytes,
    predicted_seconds,
    read_calibrations,
    run_jobs,
    scan_job,
    sole_run,
    verify_job,
    worker_count,
)
from lsvision.archive.job import WORK_FOLDER, Job
from lsvision.archive.tasks import Task, TaskResult
from lsvision.errors import ConfigError, ScansFailedError
from lsvision.experiments.settings import RunSettings
from lsvision.report.archive_pages import reprocess_report
from lsvision.report.progress import progress_bars
from lsvision.schema import PositiveInt, Text
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReprocessSettings(RunSettings):
    """Options of the experiment; products lie below ``output`` as their scans do below ``archive``."""

    archive: Text
    calibration: Text
    output: Text
    engine: EngineConfig
    disparity: DisparityConfig
    correction: CorrectionConfig
    dry_run: bool = False
    verify: bool = False
    repair_encoder: bool = False


@dataclass(frozen=True, kw_only=True)
class StatusSettings(RunSettings):
    """Options of ``+experiment=status``."""

    output: Text
    threads: PositiveInt = 1


def run_reprocess(settings: ReprocessSettings, folder: Path) -> None:
    """Find, plan, work through, report.

    Raises:
        ScansFailedError: some scans failed; the others are done.
    """
    output = Path(settings.output).absolute()
    if settings.dry_run:
        known = _known(output)
        _tell(_plan(settings, output, known[0]), known[1], settings.engine)
        return
    with sole_run(output), Ledger(output / LEDGER_FILE) as ledger:
        plan = _plan(settings, output, ledger.scans())
        _tell(plan, ledger.seconds_per_line(), settings.engine)
        begin = time.perf_counter()
        place = Place(ledger, output, _processing(settings), settings.verify)
        done = _work(settings, plan, place)
        for found, problem in plan.faulty.items():
            ledger.put_scan(ScanRow(found.key, str(found.path), "failed", error=problem))
        seconds = time.perf_counter() - begin
        keys = {scan.key for scan in (*plan.to_do, *plan.unchanged)} | {found.key for found in plan.faulty}
        rows = {key: row for key, row in ledger.scans().items() if key in keys}
    failed = {key: row for key, row in rows.items() if row.status == "failed"}
    reprocess_report(rows, done, output, seconds, asdict(settings), folder)
    for line in ledger_lines(failed):
        log.info("%s", line)
    log.info("%d done, %d unchanged, %d failed, in %.1f s", sum(row.status == "done" for row in done),
             len(plan.unchanged), len(failed), seconds)  # fmt: skip
    if failed:
        raise ScansFailedError(len(failed), len(rows), str(output / LEDGER_FILE))


def run_status(settings: StatusSettings, folder: Path) -> None:
    """Print the ledger of an output."""
    rows, _ = _known(Path(settings.output))
    if not rows:
        raise ConfigError(f"output: no ledger in {settings.output}")
    for line in ledger_lines(rows):
        log.info("%s", line)


def _plan(settings: ReprocessSettings, output: Path, known: dict[str, ScanRow]) -> Plan:
    calibrations = read_calibrations(settings.calibration)
    found = find_scans(local_archive(settings.archive, output / WORK_FOLDER / "copies"), skip=output)
    if not found:
        raise ConfigError(f"archive: no scans in {settings.archive}")
    return plan_run(found, calibrations, _processing(settings), known, output)


def _processing(settings: ReprocessSettings) -> Processing:
    return Processing(
        settings.disparity, settings.correction, settings.repair_encoder, settings.engine.worker_memory_mb
    )


def _known(output: Path) -> tuple[dict[str, ScanRow], dict[str, float]]:
    """Scans of a ledger and what a line took, without making one where there is none."""
    if not (output / LEDGER_FILE).is_file():
        return {}, {}
    with Ledger(output / LEDGER_FILE) as ledger:
        return ledger.scans(), dict(ledger.seconds_per_line())


def _tell(plan: Plan, seconds_per_line: Mapping[str, float], engine: EngineConfig) -> None:
    """Say what was found before anything starts."""
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


def _work(settings: ReprocessSettings, plan: Plan, place: Place) -> list[ScanRow]:
    """Take all jobs to their end under one bar over all lines."""
    checked = plan.unchanged if settings.verify else []
    if not plan.to_do and not checked:
        return []

    def jobs() -> Iterator[tuple[str, Job]]:
        yield from ((scan.key, scan_job(scan, place)) for scan in plan.to_do)
        yield from ((scan.key, verify_job(scan, place)) for scan in checked)

    # A line counts when its row of the product is there.
    share = {scan.key: scan.lines / scan.grid.rows for scan in plan.to_do}
    with _engine(settings.engine) as engine, progress_bars() as bars:
        bar = bars.start("reprocess", total=sum(scan.lines for scan in plan.to_do))

        def advance(task: Task, result: TaskResult) -> None:
            if task.stage == "product" and result.error is None:
                bars.advance(bar, result.lines * share.get(task.scan, 0.0))

        return run_jobs(jobs(), engine, place, advance)


def _engine(config: EngineConfig) -> Engine:
    if config.kind == "local":
        return LocalEngine(worker_count(config))
    try:
        from lsvision.archive.engines.dask import DaskEngine
    except ModuleNotFoundError as error:
        raise ConfigError(f"engine=dask needs the extra 'cluster': pip install 'lsvision[cluster]' ({error})") from None
    engine = DaskEngine(config.scheduler, worker_count(config), config.worker_memory_mb)
    log.info("dashboard: %s", engine.dashboard)
    return engine
