"""``+experiment=correct``: one scan and its calibration -> a product, with pictures."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lsvision.archive import (
    LineMotionChoice,
    Outcome,
    PlannedScan,
    Processing,
    Task,
    plan_one,
    process_one,
    product_rows,
)
from lsvision.experiments.settings import RunSettings
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import ExportFormat, export_product, read_product, write_json
from lsvision.report import product_report
from lsvision.report.line_motion_words import line_motion_words
from lsvision.report.progress import ProgressBars, progress_bars
from lsvision.report.summary import drift_in_words
from lsvision.schema import Text
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.uncertainty import drift_per_metre
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.types import MissingLines, RefusedVerdict, Verdict

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CorrectSettings(RunSettings):
    """Options of the experiment; the product is ``<scan's name>.zarr`` in ``output``, the run's folder if None.

    A scan without some of its frames or Zarr chunks is refused; with ``missing_lines`` "mark" their lines are not
    measured. ``line_motion`` is ``none``, a file, or ``auto``: the scan's own log, else what its profile shows by
    ``registration``. The formats of ``export`` are written beside it. A calibration without a usable n is refused,
    unless ``accept`` has its verdict.
    """

    scan: Text
    calibration: Text
    disparity: DisparityConfig
    correction: CorrectionConfig
    repair_encoder: bool = False
    missing_lines: MissingLines = "refuse"
    line_motion: Text = "auto"
    registration: LineMotionConfig = field(default_factory=LineMotionConfig)
    accept: list[RefusedVerdict] = field(default_factory=list)
    export: list[ExportFormat] = field(default_factory=list)
    output: Text | None = None


@dataclass(frozen=True)
class ProductSummary:
    """Size of a product, how much of it was measured, and how far off it may be.

    ``motion_mm_per_m`` is the sideways and depth motion that was corrected, mm per metre. ``drift_mm_per_m`` is the
    standard deviation of (q_x, q_y, q_z) per metre of the object, mm, that the calibration's uncertainty causes.
    ``pair`` is how the right image differed from the left one apart from disparity: lines by which it was late, of
    which whole ones were taken into account, its gain, offset and curve; None where the camera measured the depth.
    ``encoder_repair`` has the number of lines whose travel was interpolated and the largest standard deviation of their
    travel, mm; None where none was.
    ``rig_sigma`` is by how much heights may be off as a raw rig is not known exactly, on every line alike: the bend in
    um, the shift in mm and the tilt in deg of all of them; None where the rig counts as exact.
    ``missing_lines`` counts the lines of the scan that were not there. ``line_motion`` has the source of the motion
    from line to line, its components with rms, sigma and reason, and the wavelengths that may be shape.
    """

    path: str
    rows: int
    columns: int
    pitch_mm: float
    valid_share: float
    lowest_mm: float
    highest_mm: float
    verdict: Verdict
    motion_mm_per_m: tuple[float, float]
    drift_mm_per_m: tuple[float, ...]
    pair: dict[str, Any] | None
    encoder_repair: dict[str, Any] | None
    rig_sigma: dict[str, Any] | None
    missing_lines: int
    line_motion: dict[str, Any]


def run_correct(settings: CorrectSettings, folder: Path) -> None:
    """Correct the scan with the calibration's motion and write the product."""
    processing = Processing(
        settings.disparity,
        settings.correction,
        settings.repair_encoder,
        worker_memory_mb=None,
        missing_lines=settings.missing_lines,
        line_motion=LineMotionChoice.of(settings.line_motion, settings.registration),
    )
    planned = plan_one(settings.scan, settings.calibration, processing, settings.accept)
    if planned.calibration.warning:
        log.warning("%s", planned.calibration.warning)
    with progress_bars() as bars:
        summary = make_product(planned, processing, Path(settings.output or folder), bars)
    write_json(folder / "summary.json", asdict(summary))
    target = Path(summary.path)
    product = read_product(target)
    for name in settings.export:
        for file in export_product(product, name, target.with_suffix("")):
            log.info("wrote %s", file)
    product_report(product, planned.calibration.calibration, summary.valid_share, asdict(settings), folder)
    log.info(
        "wrote %s: %d x %d cells of %.3f mm, %.1f %% measured, heights %.1f..%.1f mm",
        target, summary.rows, summary.columns, summary.pitch_mm, 100 * summary.valid_share,
        summary.lowest_mm, summary.highest_mm,
    )  # fmt: skip
    motion = planned.calibration.calibration.motion
    log.info("calibration %s, corrected motion %s", summary.verdict, drift_in_words(motion))
    for line in line_motion_words(summary.line_motion):
        log.info("%s", line)
    if summary.pair is not None:
        log.info("%s", _pair_in_words(summary.pair))
    if summary.rig_sigma is not None:
        log.info(
            "by what is not known of the rig, on every line alike: heights bent by %.2g um rms, all shifted by %.2g mm "
            "and tilted by %.2g deg",
            *(summary.rig_sigma[name] for name in ("bend_sigma_um", "shift_sigma_mm", "tilt_sigma_deg")),
        )
    if summary.encoder_repair is not None:
        log.info(
            "encoder log repaired: travel of %d lines interpolated, known to %.2g mm at worst",
            summary.encoder_repair["repaired_lines"], summary.encoder_repair["largest_sigma_mm"],
        )  # fmt: skip


def _pair_in_words(pair: Mapping[str, Any]) -> str:
    """How the right image differed from the left one."""
    offset = pair["row_offset_lines"]
    if offset is None:  # JSON has no NaN
        rows = "row offset not measured"
    elif pair["row_offset_used_lines"]:
        rows = (
            f"{offset:+.2f} lines out of step with the left one: matched {pair['row_offset_used_lines']:+d} lines "
            "later, travel and lines are those of the left camera"
        )
    else:
        rows = f"in step with the left one to {offset:+.2f} lines"
    low, high = pair["right_gain"]
    bright = (
        "as bright" if (low, high) == (1.0, 1.0) else f"brought to its brightness by a gain of {low:.2f}..{high:.2f}"
    )
    return f"right image {rows}; {bright}"


def _entry(metadata: Mapping[str, Any], name: str) -> dict[str, Any] | None:
    """A group of a product's metadata; None where it has none of that name."""
    entry = metadata.get(name)
    return dict(entry) if isinstance(entry, Mapping) else None


def make_product(planned: PlannedScan, processing: Processing, output: Path, bars: ProgressBars) -> ProductSummary:
    """Make a scan's product as the archive does, in this process, under a bar over its rows."""
    keep_freed_memory()
    grid = planned.grid
    bar = bars.start(f"correct {planned.key}", total=grid.rows)

    def advance(task: Task, outcome: Outcome) -> None:
        bars.advance(bar, product_rows(task, outcome))

    product = process_one(planned, processing, output, advance)
    metadata = read_product(product.path).metadata
    return ProductSummary(
        path=str(product.path),
        rows=grid.rows,
        columns=grid.columns,
        pitch_mm=grid.pitch_mm,
        valid_share=product.measured.count / (grid.rows * grid.columns),
        lowest_mm=product.measured.lowest_mm,
        highest_mm=product.measured.highest_mm,
        verdict=planned.calibration.calibration.verdict,
        motion_mm_per_m=planned.calibration.calibration.motion.drift_mm_per_m,
        drift_mm_per_m=drift_per_metre(planned.calibration.calibration.motion),
        pair=_entry(metadata, "pair"),
        encoder_repair=_entry(metadata, "encoder_repair"),
        rig_sigma=_entry(metadata, "rig_sigma"),
        missing_lines=planned.missing_lines,
        line_motion=_entry(metadata, "line_motion") or {},
    )
