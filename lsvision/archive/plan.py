"""What a run has to do, before it starts: which scans, how long it will take and how large it will get."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lsvision import __version__
from lsvision.archive.ledger import ScanRow
from lsvision.archive.line_motion import LineMotionChoice
from lsvision.archive.planned import PlannedScan, Processing, plan_scan
from lsvision.archive.product import product_path
from lsvision.archive.sources.calibrations import DatedCalibration
from lsvision.archive.sources.catalogue import Found
from lsvision.errors import LsvisionError

# Seconds of a pixel and stage on one core, until the ledger knows better.
_USUAL_SECONDS_PER_PX = {"disparity": 1.5e-6, "line_motion": 0.1e-6, "product": 1.0e-6}


@dataclass(frozen=True)
class Plan:
    """The scans of an archive: to do, unchanged since they were done, and faulty with their reason."""

    to_do: list[PlannedScan]
    unchanged: list[PlannedScan]
    faulty: dict[Found, str]
    line_motion: LineMotionChoice = field(default_factory=LineMotionChoice)


def plan_run(
    found: Sequence[Found],
    calibrations: Sequence[DatedCalibration],
    processing: Processing,
    known: Mapping[str, ScanRow],
    output: Path,
) -> Plan:
    """Read every scan, but not its images, and compare it with the ledger.

    Args:
        known: the rows of the ledger.
    """
    plan = Plan([], [], {}, processing.line_motion)
    for item in found:
        try:
            product_path(output, item.key)
            scan = plan_scan(item, calibrations, processing)
        except LsvisionError as error:
            plan.faulty[item] = str(error)
        except OSError as error:
            plan.faulty[item] = f"{error.filename or item.path}: {error.strerror}"
        else:
            (plan.unchanged if _is_done(scan, known.get(item.key), processing, output) else plan.to_do).append(scan)
    return plan


def predicted_seconds(plan: Plan, seconds_per_line: Mapping[str, float], workers: int) -> float:
    """How long a run will take, by the mean time of a line so far, else by the usual time of a pixel."""
    seconds = 0.0
    for scan in plan.to_do:
        lines_of = {
            "disparity": scan.lines if scan.matched else 0,
            "line_motion": 0 if plan.line_motion.origin(scan.logged) == "none" else scan.lines,
            "product": scan.grid.rows,
        }
        for stage, lines in lines_of.items():
            seconds += lines * seconds_per_line.get(stage, scan.width * _USUAL_SECONDS_PER_PX[stage])
    return seconds / workers


def predicted_bytes(plan: Plan) -> int:
    """Size of products and kept depth on disk before compression: an upper bound."""
    return sum(
        scan.grid.rows * scan.grid.columns * scan.cell_bytes + (4 * scan.lines * scan.width if scan.matched else 0)
        for scan in plan.to_do
    )


def _is_done(scan: PlannedScan, row: ScanRow | None, processing: Processing, output: Path) -> bool:
    return (
        row is not None
        and row.status == "done"
        and (row.stamp, row.calibration_sha256, row.config_sha256, row.version)
        == (scan.files.stamp, scan.calibration.sha256, processing.sha256, __version__)
        and (product_path(output, scan.key) / "zarr.json").is_file()
    )
