"""``+experiment=correct``: one scan and its calibration -> a product, with pictures."""

import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path

from lsvision import __version__
from lsvision.experiments.settings import RunSettings, settings_sha256
from lsvision.geometry import ProductFrame
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import (
    ExportFormat,
    ProductLayout,
    ProductWriter,
    check_rig_match,
    export_product,
    read_calibration,
    read_product,
    read_scan,
    write_json,
)
from lsvision.report import product_report
from lsvision.report.progress import ProgressBars, progress_bars
from lsvision.schema import Text
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.correction.uncertainty import drift_per_metre
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import Motion, ProductGrid, Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CorrectSettings(RunSettings):
    """Options of the experiment; the product is ``<scan's name>.zarr`` in ``output``, the run's folder if None.

    The formats of ``export`` are written beside it.
    """

    scan: Text
    calibration: Text
    disparity: DisparityConfig
    correction: CorrectionConfig
    repair_encoder: bool = False
    export: list[ExportFormat] = field(default_factory=list)
    output: Text | None = None


@dataclass(frozen=True)
class ProductSummary:
    """Size of a product, how much of it was measured, and how far off it may be.

    ``drift_mm_per_m`` is what the calibration leaves open of (q_x, q_y, q_z), one standard deviation per metre of the
    object.
    """

    path: str
    rows: int
    columns: int
    pitch_mm: float
    valid_share: float
    lowest_mm: float
    highest_mm: float
    drift_mm_per_m: tuple[float, ...]


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
    write_json(folder / "summary.json", asdict(summary))
    product = read_product(target)
    for name in settings.export:
        for file in export_product(product, name, target.with_suffix("")):
            log.info("wrote %s", file)
    product_report(product, summary.valid_share, asdict(settings), folder)
    log.info(
        "wrote %s: %d x %d cells of %.3f mm, %.1f %% measured, heights %.1f..%.1f mm, "
        "drift per metre up to %.3f mm (one sigma)",
        target, summary.rows, summary.columns, summary.pitch_mm, 100 * summary.valid_share,
        summary.lowest_mm, summary.highest_mm, max(summary.drift_mm_per_m),
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
    keep_freed_memory()
    depth, grid = depth_of(scan, disparity), plan_product(scan, motion, correction)
    layout = product_layout(scan, motion, correction, grid, metadata or {})
    bar = bars.start(f"correct {target.stem}", total=grid.rows)
    valid, low, high = 0, float("inf"), float("-inf")
    with ProductWriter(target, layout) as writer:
        for strip in correct_scan(scan, depth, motion, correction, grid):
            writer.write(strip.row, strip.color, strip.height, strip.valid, strip.source, strip.sigma)
            bars.advance(bar, strip.color.shape[0])
            if bool(strip.valid.any()):
                measured = strip.height[strip.valid]
                valid += measured.numel()
                low, high = min(low, float(measured.min())), max(high, float(measured.max()))
    share, drift = valid / (grid.rows * grid.columns), drift_per_metre(motion)
    return ProductSummary(str(target), grid.rows, grid.columns, grid.pitch_mm, share, low, high, drift)


def product_layout(
    scan: Scan, motion: Motion, correction: CorrectionConfig, grid: ProductGrid, metadata: dict
) -> ProductLayout:
    """Layout of the product that a correction's strips fill, one chunk a strip."""
    return ProductLayout(
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
            "height_datum_mm": ProductFrame(scan.rig, scan.travel, motion.n).height_datum_mm,
            "attributes": dict(scan.attributes),
            **metadata,
        },
        uncertainty=correction.uncertainty,
    )
