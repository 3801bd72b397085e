"""The ledger's rows: of a scan, from its start to its end, and of a strip."""

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

from lsvision import __version__
from lsvision.archive.health import ScanHealth
from lsvision.archive.inspection import InspectedProduct
from lsvision.archive.ledger import ScanRow, StripRow
from lsvision.archive.line_motion import FoundLineMotion, StoredLineMotion
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.archive.tasks import Outcome, Task
from lsvision.archive.work import StripResult
from lsvision.stages.correction.uncertainty import drift_per_metre


def running_row(planned: PlannedScan, processing: Processing, known: ScanRow | None) -> ScanRow:
    """The row of a scan that is being worked on.

    Args:
        known: the row before, whose hash of the files stands as long as they are untouched.
    """
    calibration = planned.calibration.calibration
    sideways, in_depth = calibration.motion.drift_mm_per_m
    untouched = known is not None and known.stamp == planned.files.stamp
    return ScanRow(
        scan=planned.key,
        path=planned.files.path,
        status="running",
        lines=planned.lines,
        missing_lines=planned.missing_lines,
        stamp=planned.files.stamp,
        input_sha256=known.input_sha256 if known is not None and untouched else "",
        calibration=str(planned.calibration.path),
        calibration_sha256=planned.calibration.sha256,
        config_sha256=processing.sha256,
        version=__version__,
        verdict=calibration.verdict,
        sideways_mm_per_m=sideways,
        in_depth_mm_per_m=in_depth,
        drift_sigma_mm_per_m=max(drift_per_metre(calibration.motion)),
        taken=planned.taken,
        **(_health_of(known) if known is not None and untouched else {}),
    )


def _health_of(row: ScanRow) -> dict[str, Any]:
    """The signals of drift of a row."""
    return {item.name: getattr(row, item.name) for item in fields(ScanHealth)}


def finished_row(
    row: ScanRow, strips: Iterable[StripRow], measured_share: float, found: StoredLineMotion | None
) -> ScanRow:
    """The row of a scan whose product is there.

    Args:
        strips: all of the scan's. measured_share: of the product's cells. found: its motion from line to line.
    """
    seconds = sum(strip.seconds for strip in strips)
    row = replace(row, status="done", seconds=seconds, measured_share=measured_share)
    if found is None:
        return replace(row, line_motion="none")
    rms = {finding.component: finding.rms for finding in found.motion.findings if finding.state == "corrected"}
    return replace(
        row,
        line_motion=f"{found.origin}: {'; '.join(finding.in_words for finding in found.motion.findings)}",
        rms_dx_mm=rms.get("dx", 0.0),
        rms_dz_mm=rms.get("dz", 0.0),
        rms_roll_rad=rms.get("roll", 0.0),
        rms_dy_mm=rms.get("dy", 0.0),
    )


def strip_row(task: Task, outcome: Outcome) -> StripRow | None:
    """The row of the strip that a task made, or failed to make; None where it makes none."""
    strip, result = task.strip, outcome.result
    if strip is None:
        return None
    row = StripRow(
        task.scan, strip.stage, strip.number, strip.key,
        "failed" if outcome.error else "done", outcome.error or "", seconds=outcome.seconds,
    )  # fmt: skip
    if isinstance(result, StripResult):
        cells = result.measured
        return replace(
            row, lines=result.lines, measured_cells=cells.count, lowest_mm=cells.lowest_mm, highest_mm=cells.highest_mm
        )
    if isinstance(result, FoundLineMotion | InspectedProduct):
        return replace(row, lines=result.lines)
    return row
