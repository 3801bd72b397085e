"""Archives of scans: found, planned, worked through in strips on many workers, and booked in a ledger."""

from lsvision.archive.driver import run_jobs
from lsvision.archive.engines.local import LocalEngine
from lsvision.archive.engines.protocol import Engine, EngineConfig, worker_count
from lsvision.archive.job import Place, scan_job, verify_job
from lsvision.archive.ledger import LEDGER_FILE, Ledger, ScanRow, StripRow, ledger_lines
from lsvision.archive.lock import sole_run
from lsvision.archive.plan import (
    Plan,
    PlannedScan,
    Processing,
    plan_run,
    predicted_bytes,
    predicted_seconds,
    product_path,
)
from lsvision.archive.sources.calibrations import DatedCalibration, calibration_for, read_calibrations
from lsvision.archive.sources.catalogue import Found, find_scans
from lsvision.archive.sources.remote import local_archive

__all__ = [
    "LEDGER_FILE",
    "DatedCalibration",
    "Engine",
    "EngineConfig",
    "Found",
    "Ledger",
    "LocalEngine",
    "Place",
    "Plan",
    "PlannedScan",
    "Processing",
    "ScanRow",
    "StripRow",
    "calibration_for",
    "find_scans",
    "ledger_lines",
    "local_archive",
    "plan_run",
    "predicted_bytes",
    "predicted_seconds",
    "product_path",
    "read_calibrations",
    "run_jobs",
    "scan_job",
    "sole_run",
    "verify_job",
    "worker_count",
]
