"""``--multirun``: every job records how it ended, and a callback gathers all jobs into one table and one report.

A job that fails does not end the sweep: its reason is written beside its log, and the sweep's exit code is 1. The
results of a job are read from its folder alone, so the launcher does not matter (basic, joblib, submitit).
"""

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars
from omegaconf import OmegaConf

from lsvision.errors import ConfigError, LsvisionError
from lsvision.experiments.settings import RunSettings
from lsvision.io import write_json
from lsvision.io.parquet import write_parquet
from lsvision.report import SweepJob, sweep_report
from lsvision.schema import PositiveInt, Text

log = logging.getLogger(__name__)

_RECORD, _SUMMARY = "job.json", "summary.json"


@dataclass(frozen=True, kw_only=True)
class CollectSettings(RunSettings):
    """Options of ``+experiment=collect``; ``sweep`` is the folder of a sweep whose submitting process has ended."""

    sweep: Text
    threads: PositiveInt = 1


def run_collect(settings: CollectSettings, folder: Path) -> None:
    """Gather a sweep's jobs, finished or not, into a table and a report in the sweep's folder."""
    sweep = Path(settings.sweep)
    if not sweep.is_dir():
        raise ConfigError(f"sweep: no folder {sweep}")
    collect_sweep(sweep)


def run_job(experiment: Callable[[], None], folder: Path, overrides: Sequence[str]) -> Exception | None:
    """Run one job of a sweep and record how it ended; the error of a failed job is returned, so that the others run."""
    begin, failure = time.time(), None
    try:
        experiment()
    except Exception as error:
        failure = error
    record = {
        "overrides": list(overrides),
        "seconds": round(time.time() - begin, 3),
        "reason": "" if failure is None else _reason(failure),
    }
    write_json(folder / _RECORD, record)
    return failure


def collect_sweep(folder: Path) -> list[SweepJob]:
    """Read all jobs of a sweep; write ``sweep.parquet``, ``report.html`` and, for studies, ``points.parquet``.

    A job without a record was killed, or has not ended yet.

    Raises:
        ConfigError: the folder holds no jobs.
    """
    folders = [path.parent.parent for path in folder.glob("*/.hydra/overrides.yaml")]
    if not folders:
        raise ConfigError(f"sweep: {folder} holds no jobs")
    jobs = [_read_job(path) for path in sorted(folders, key=lambda path: (len(path.name), path.name))]
    table = polars.DataFrame([_row(job) for job in jobs], infer_schema_length=None)
    write_parquet(table, folder / "sweep.parquet")
    studies = [job for job in jobs if (folder / job.name / "points.parquet").is_file() and not job.reason]
    if studies:
        tables = [polars.read_parquet(folder / job.name / "points.parquet") for job in studies]
        rows = [rows.with_columns(polars.lit(job.name).alias("job")) for job, rows in zip(studies, tables, strict=True)]
        write_parquet(polars.concat(rows, how="diagonal_relaxed"), folder / "points.parquet")
    sweep_report(jobs, folder)
    log.info(
        "%d of %d jobs succeeded; wrote %s", sum(not job.reason for job in jobs), len(jobs), folder / "report.html"
    )
    return jobs


def _read_job(folder: Path) -> SweepJob:
    overrides = [str(item) for item in OmegaConf.load(folder / ".hydra" / "overrides.yaml")]
    if not (folder / _RECORD).is_file():
        return SweepJob(folder.name, overrides, "ended without a result: killed, or still running", None, {})
    record = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
    summary = folder / _SUMMARY
    results = _flat(json.loads(summary.read_text(encoding="utf-8"))) if summary.is_file() else {}
    return SweepJob(folder.name, overrides, record["reason"], record["seconds"], {} if record["reason"] else results)


def _row(job: SweepJob) -> dict[str, object]:
    return {"job": job.name, **job.options, "seconds": job.seconds, "reason": job.reason, **job.results}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, float | str | bool]:
    """Scalars of nested values by dotted names; lists of three or fewer are numbered from 1, longer ones dropped."""
    flat: dict[str, float | str | bool] = {}
    for key, value in values.items():
        if isinstance(value, list) and len(value) <= 3:
            value = {str(index): item for index, item in enumerate(value, start=1)}
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        elif isinstance(value, bool | int | float | str):
            flat[f"{prefix}{key}"] = value
    return flat


def _reason(error: Exception) -> str:
    text = str(error).splitlines()[0] if str(error) else ""
    return text if isinstance(error, LsvisionError) else f"{type(error).__name__}: {text}"
