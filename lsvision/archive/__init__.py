"""Archives of scans: found, planned, processed in strips on many workers, and recorded in a ledger."""

from lsvision.archive.alarms import SIGNALS, Alarm, Signal, alarms, groups_of, health_in_words, measured_of
from lsvision.archive.driver import damaged_products, process_scans
from lsvision.archive.engines.in_process import InProcessEngine
from lsvision.archive.engines.local import LocalEngine
from lsvision.archive.engines.protocol import Engine, EngineConfig, worker_count
from lsvision.archive.job import WORK_FOLDER, Place
from lsvision.archive.ledger import LEDGER_FILE, Ledger, ScanRow, StripRow, ledger_lines
from lsvision.archive.line_motion import LineMotionChoice, measured_line_motion
from lsvision.archive.lock import is_worked_on, sole_run
from lsvision.archive.one_scan import FinishedProduct, plan_one, process_one
from lsvision.archive.plan import Plan, plan_run, predicted_bytes, predicted_seconds
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.archive.product import product_path
from lsvision.archive.sources.calibrations import DatedCalibration, calibration_for, read_calibrations
from lsvision.archive.sources.catalogue import Found, find_scans
from lsvision.archive.sources.remote import local_archive
from lsvision.archive.surfaces import InspectedScan, gather_surfaces, worst_candidates
from lsvision.archive.tasks import Outcome, Task, product_rows

__all__ = [
    "LEDGER_FILE",
    "SIGNALS",
    "WORK_FOLDER",
    "Alarm",
    "DatedCalibration",
    "Engine",
    "EngineConfig",
    "FinishedProduct",
    "Found",
    "InProcessEngine",
    "InspectedScan",
    "Ledger",
    "LineMotionChoice",
    "LocalEngine",
    "Outcome",
    "Place",
    "Plan",
    "PlannedScan",
    "Processing",
    "ScanRow",
    "Signal",
    "StripRow",
    "Task",
    "alarms",
    "calibration_for",
    "damaged_products",
    "find_scans",
    "gather_surfaces",
    "groups_of",
    "health_in_words",
    "is_worked_on",
    "ledger_lines",
    "local_archive",
    "measured_line_motion",
    "measured_of",
    "plan_one",
    "plan_run",
    "predicted_bytes",
    "predicted_seconds",
    "process_one",
    "process_scans",
    "product_path",
    "product_rows",
    "read_calibrations",
    "sole_run",
    "worker_count",
    "worst_candidates",
]
