"""What a run has to do, before it starts: which scans, in which strips, how long and how large."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lsvision import __version__
from lsvision.archive.identity import key_of, stamp_of
from lsvision.archive.ledger import ScanRow
from lsvision.archive.sources.calibrations import DatedCalibration, calibration_for
from lsvision.archive.sources.catalogue import Found
from lsvision.errors import FileFormatError, LsvisionError
from lsvision.io import read_scan
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import disparity_range
from lsvision.types import ProductGrid, Scan, StereoPair

# Peak of a worker over an idle one, as measured; an idle one holds torch, OpenCV and the decoded ends of its files.
IDLE_BYTES = 500 * 2**20
_CORRECTION_BYTES_PER_PX = 120
_MATCHING_BYTES_PER_PX = 120
_LEAST_ROWS = 32

# Seconds a pixel and stage on one core, until the ledger knows better.
_USUAL_SECONDS_PER_PX = {"disparity": 1.5e-6, "product": 1.0e-6}


@dataclass(frozen=True)
class Processing:
    """What is done to every scan, and the memory a worker may take for it."""

    disparity: DisparityConfig
    correction: CorrectionConfig
    repair_encoder: bool
    worker_memory_mb: int

    @property
    def with_sigma(self) -> bool:
        """Whether the standard deviation of the matched depth is kept with it."""
        return self.correction.uncertainty and self.disparity.tells_sigma

    @property
    def sha256(self) -> str:
        """Hash of what the products depend on; the height of strips of rows is not among it."""
        correction = asdict(self.correction)
        del correction["strip_rows"]
        return key_of(asdict(self.disparity), correction, self.repair_encoder)


@dataclass(frozen=True)
class PlannedScan:
    """A scan that can be processed: what it is, its calibration, and the grid and strips of its product."""

    key: str
    path: Path
    stamp: str
    lines: int
    width: int
    matched: bool
    cell_bytes: int
    calibration: DatedCalibration
    grid: ProductGrid
    correction: CorrectionConfig


@dataclass(frozen=True)
class Plan:
    """The scans of an archive: to do, unchanged since they were done, and faulty with their reason."""

    to_do: list[PlannedScan]
    unchanged: list[PlannedScan]
    faulty: dict[Found, str]


def plan_run(
    found: Sequence[Found],
    calibrations: Sequence[DatedCalibration],
    processing: Processing,
    known: Mapping[str, ScanRow],
    output: Path,
) -> Plan:
    """Look into every scan, without reading its images, and hold it against the ledger."""
    plan = Plan([], [], {})
    for item in found:
        try:
            scan = _planned(item, calibrations, processing)
        except LsvisionError as error:
            plan.faulty[item] = str(error)
        except OSError as error:
            plan.faulty[item] = f"{error.filename or item.path}: {error.strerror}"
        else:
            (plan.unchanged if _is_done(scan, known.get(item.key), processing, output) else plan.to_do).append(scan)
    return plan


def product_path(output: Path, key: str) -> Path:
    """Where the product of a scan lies."""
    return output / f"{key}.zarr"


def predicted_seconds(plan: Plan, seconds_per_line: Mapping[str, float], workers: int) -> float:
    """How long a run will take, by what a line took so far, else by what a pixel usually takes."""
    seconds = 0.0
    for scan in plan.to_do:
        for stage, lines in (("disparity", scan.lines if scan.matched else 0), ("product", scan.grid.rows)):
            seconds += lines * seconds_per_line.get(stage, scan.width * _USUAL_SECONDS_PER_PX[stage])
    return seconds / workers


def predicted_bytes(plan: Plan) -> int:
    """What products and kept depth take on disk before compression: a bound."""
    return sum(
        scan.grid.rows * scan.grid.columns * scan.cell_bytes + (4 * scan.lines * scan.width if scan.matched else 0)
        for scan in plan.to_do
    )


def rows_for_memory(width: int, halo_lines: int, most: int, memory_bytes: int) -> int:
    """Rows of a product that a worker can compute at once: a power of two times the least, at most ``most``.

    Raises:
        ValueError: not even the least fits.
    """
    room = (memory_bytes - IDLE_BYTES) // (_CORRECTION_BYTES_PER_PX * width) - halo_lines
    least = min(_LEAST_ROWS, most)
    if room < least:
        needed = IDLE_BYTES + (least + halo_lines) * width * _CORRECTION_BYTES_PER_PX
        raise ValueError(f"a worker needs {needed >> 20} MB for {least} rows of {width} px, it may take "
                         f"{memory_bytes >> 20} MB")  # fmt: skip
    rows = least
    while 2 * rows <= min(room, most):
        rows *= 2
    return most if room >= most else rows


def _planned(item: Found, calibrations: Sequence[DatedCalibration], processing: Processing) -> PlannedScan:
    if item.problem is not None:
        raise FileFormatError(item.path, item.problem)
    stamp = stamp_of(item.path)
    scan = read_scan(item.path, repair_encoder=processing.repair_encoder)
    calibration = calibration_for(scan, calibrations)
    grid = plan_product(scan, calibration.calibration.motion, processing.correction)
    return PlannedScan(
        key=item.key,
        path=item.path,
        stamp=stamp,
        lines=scan.lines,
        width=scan.rig.width_px,
        matched=isinstance(scan.images, StereoPair),
        cell_bytes=scan.left.shape[2] * scan.left.dtype.itemsize + 13,  # height 4, valid 1, source 8
        calibration=calibration,
        grid=grid,
        correction=dataclasses.replace(
            processing.correction, strip_rows=_strip_rows(scan, grid, processing, item.path)
        ),
    )


def _strip_rows(scan: Scan, grid: ProductGrid, processing: Processing, path: Path) -> int:
    memory_bytes = processing.worker_memory_mb * 2**20
    if isinstance(scan.images, StereoPair):
        low, high = disparity_range(scan.rig, processing.disparity)
        disparity = processing.disparity.for_width(scan.rig.width_px)
        lines = disparity.block_lines + 2 * (disparity.halo_lines or 0)
        # Besides images and their gradients the matcher keeps costs of a few lines over the whole range.
        needed = IDLE_BYTES + scan.rig.width_px * (lines * _MATCHING_BYTES_PER_PX + 64 * (high - low))
        if needed > memory_bytes:
            raise FileFormatError(
                path, f"matching its strips needs {needed >> 20} MB, a worker may take {processing.worker_memory_mb} MB"
            )
    halo = max(grid.rows - scan.lines, 0)  # the skew of a line, which every strip has to read beyond its rows
    try:
        return rows_for_memory(scan.rig.width_px, halo, processing.correction.strip_rows, memory_bytes)
    except ValueError as error:
        raise FileFormatError(path, str(error)) from error


def _is_done(scan: PlannedScan, row: ScanRow | None, processing: Processing, output: Path) -> bool:
    return (
        row is not None
        and row.status == "done"
        and (row.stamp, row.calibration_sha256, row.config_sha256, row.version)
        == (scan.stamp, scan.calibration.sha256, processing.sha256, __version__)
        and (product_path(output, scan.key) / "zarr.json").is_file()
    )
