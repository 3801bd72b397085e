"""``+experiment=correct``: one scan and its calibration -> a product, with pictures."""

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path

from lsvision import __version__
from lsvision.experiments.progress import ProgressBars, progress_bars
from lsvision.experiments.settings import RunSettings, settings_sha256
from lsvision.io import ProductWriter, check_rig_match, read_calibration, read_product, read_scan, write_text
from lsvision.report import product_report
from lsvision.stages.correction import CorrectionConfig, correct_scan, plan_product
from lsvision.stages.disparity import DisparityConfig, depth_of
from lsvision.types import Motion, Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CorrectSettings(RunSettings):
    """Options of the experiment; the product is ``<scan's name>.zarr`` in ``output``, the run's folder if None."""

    scan: str
    calibration: str
    disparity: DisparityConfig
    correction: CorrectionConfig
    repair_encoder: bool = False
    output: str | None = None


@dataclass(frozen=True)
class ProductSummary:
    """Size of a product and how much of it was measured."""

    path: str
    rows: int
    columns: int
    pitch_mm: float
    valid_share: float
    lowest_mm: float
    highest_mm: float


def run_correct(settings: CorrectSettings, folder: Path) -> None:
    """Correct the scan with the calibration's motion and write the product."""
    scan = read_scan(settings.scan, repair_encoder=settings.repair_encoder)
    calibration = read_calibration(settings.calibration)
    check_rig_match(calibration, scan)
    target = Path(settings.output or folder) / f"{scan.path.resolve().name}.zarr"
    metadata = {"calibration": settings.calibration, "config_sha256": settings_sha256(settings)}
    with progress_bars() as bars:
        summary = write_product(
            scan, calibration.motion, settings.disparity, settings.correction, target, bars, metadata
        )
    write_text(folder / "summary.json", json.dumps(asdict(summary), indent=2) + "\n")
    product_report(read_product(target), summary.valid_share, asdict(settings), folder)
    log.info(
        "wrote %s: %d x %d cells of %.3f mm, %.1f %% measured, heights %.1f..%.1f mm",
        target, summary.rows, summary.columns, summary.pitch_mm, 100 * summary.valid_share,
        summary.lowest_mm, summary.highest_mm,
    )  # fmt: skip


def write_product(
    scan: Scan,
    motion: Motion,
    disparity: DisparityConfig,
    correction: CorrectionConfig,
    target: Path,
    bars: ProgressBars,
    metadata: dict | None = None,
) -> ProductSummary:
    """Stream a scan through disparity and correction into a product on disk."""
    grid = plan_product(scan, motion, correction)
    bar = bars.start(f"correct {target.stem}", total=grid.rows)
    valid, low, high = 0, float("inf"), float("-inf")
    with ProductWriter(
        target,
        shape=(grid.rows, grid.columns),
        pitch_mm=grid.pitch_mm,
        origin_mm=(grid.origin_y_mm, grid.origin_x_mm),
        channels=scan.left.shape[2],
        dtype=scan.left.dtype,
        chunk_rows=correction.strip_rows,
        metadata={
            "scan": str(scan.path),
            "version": __version__,
            "n": motion.n.tolist(),
            "zero_disparity_mm": scan.rig.zero_disparity_mm,
            "attributes": dict(scan.attributes),
            **(metadata or {}),
        },
    ) as writer:
        for strip in correct_scan(scan, depth_of(scan, disparity), motion, correction, grid):
            writer.write(strip.row, strip.color, strip.height, strip.valid, strip.source)
            bars.advance(bar, strip.color.shape[0])
            if bool(strip.valid.any()):
                measured = strip.height[strip.valid]
                valid += measured.numel()
                low, high = min(low, float(measured.min())), max(high, float(measured.max()))
    share = valid / (grid.rows * grid.columns)
    return ProductSummary(str(target), grid.rows, grid.columns, grid.pitch_mm, share, low, high)
