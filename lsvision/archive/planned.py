"""One scan as it will be processed: its files, its calibration, and the grid and strips of its product."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import psutil

from lsvision.archive.identity import ScanFiles, key_of, options_without_strips, stamp_of
from lsvision.archive.line_motion import LineMotionChoice
from lsvision.archive.sources.calibrations import DatedCalibration, calibration_for
from lsvision.archive.sources.catalogue import Found
from lsvision.errors import FileFormatError
from lsvision.geometry import ProductFrame, Rectification
from lsvision.io import read_scan
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.grid import most_lines, plan_product, source_dtype
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import disparity_range
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.types import MissingLines, ProductGrid, Scan, StereoPair

# Peak of a worker over an idle one, as measured; an idle one holds torch, OpenCV and the decoded ends of its files.
IDLE_BYTES = 500 * 2**20
_CORRECTION_BYTES_PER_PX = 120
_MATCHING_BYTES_PER_PX = 120
_COST_BYTES_PER_PX = 64  # and disparity: the matcher keeps the costs of a few lines over the whole range
_MIN_ROWS = 32


@dataclass(frozen=True)
class Processing:
    """What is done to every scan, and the memory that a worker may take for it; None for all that the machine has.

    ``surface`` is how the surfaces of products are inspected; None where they are not.
    """

    disparity: DisparityConfig
    correction: CorrectionConfig
    repair_encoder: bool
    worker_memory_mb: int | None
    missing_lines: MissingLines = "refuse"
    line_motion: LineMotionChoice = field(default_factory=LineMotionChoice)
    surface: SurfaceConfig | None = None

    @property
    def with_sigma(self) -> bool:
        """Whether the standard deviation of the matched depth is kept with it."""
        return self.correction.uncertainty and self.disparity.tells_sigma

    @property
    def sha256(self) -> str:
        """Hash of the options that products depend on; the height of strips of rows is not part of it."""
        options = options_without_strips(self.correction)
        kept = self.repair_encoder, self.missing_lines, self.line_motion.key
        inspected = () if self.surface is None else (asdict(self.surface),)
        return key_of(asdict(self.disparity), options, *kept, *inspected)


@dataclass(frozen=True)
class PlannedScan:
    """A scan that can be processed.

    ``matched`` says whether its depth has to be matched, ``cell_bytes`` is the size of a cell of its product, and
    ``correction`` has the strips that fit the memory of a worker. ``missing_lines`` counts those that are not there.
    ``logged`` says whether the scan has a log of its motion from line to line, ``taken`` is its attribute ``date``.
    """

    key: str
    files: ScanFiles
    lines: int
    width: int
    matched: bool
    cell_bytes: int
    calibration: DatedCalibration
    grid: ProductGrid
    correction: CorrectionConfig
    missing_lines: int = 0
    logged: bool = False
    taken: str = ""

    @property
    def n(self) -> tuple[float, ...]:
        """The motion of its calibration."""
        return tuple(self.calibration.calibration.motion.n.tolist())

    @property
    def covariance(self) -> tuple[tuple[float, ...], ...]:
        """That of ``n``."""
        return tuple(map(tuple, self.calibration.calibration.motion.covariance.tolist()))

    @property
    def product_strips(self) -> int:
        """Number of strips of its product."""
        return -(-self.grid.rows // self.correction.strip_rows)


def plan_scan(found: Found, calibrations: Sequence[DatedCalibration], processing: Processing) -> PlannedScan:
    """Read a scan, but not its images, and plan its product.

    Raises:
        FileFormatError: the scan or the file of its line motion cannot be read, or it not be processed in a worker's
            memory.
        CalibrationError: no calibration fits it, or more than one does.
        ConfigError: the pitch of the product is not positive.
    """
    if found.problem is not None:
        raise FileFormatError(found.path, found.problem)
    scan = read_scan(found.path, repair_encoder=processing.repair_encoder, missing_lines=processing.missing_lines)
    stamp = stamp_of(found.path)  # of files that are known to be images: a folder of any other kind may have no end
    calibration = calibration_for(scan, calibrations)
    motion = calibration.calibration.motion
    if processing.line_motion.origin(scan.line_motion is not None) == "file":
        processing.line_motion.read_file(scan.lines, scan.travel)  # what does not fit is noticed before anything starts
    grid, frame = plan_product(scan, motion, processing.correction), ProductFrame(scan.rig, scan.travel, motion.n)
    return PlannedScan(
        key=found.key,
        files=ScanFiles(
            str(found.path),
            stamp,
            scan.lines,
            processing.repair_encoder,
            processing.missing_lines,
            None if Rectification.of(scan.raw_rig) is None else tuple(motion.n.tolist()),
        ),
        lines=scan.lines,
        width=scan.rig.width_px,
        matched=isinstance(scan.images, StereoPair),
        # height 4, valid 1, source twice its type
        cell_bytes=scan.left.shape[2] * scan.left.dtype.itemsize + 5 + 2 * source_dtype(scan.lines).itemsize,
        calibration=calibration,
        grid=grid,
        correction=replace(processing.correction, strip_rows=_strip_rows(scan, frame, grid, processing)),
        missing_lines=scan.missing_lines,
        logged=scan.line_motion is not None,
        taken=scan.attributes.get("date", ""),
    )


def rows_for_memory(width: int, halo_lines: float, most: int, memory_bytes: int, *, lines_per_row: float = 1.0) -> int:
    """Rows of a product that a worker can compute at once: ``most`` if they fit, else a power of two times the minimum.

    Args:
        halo_lines: lines that every strip reads beyond those of its rows.

    Raises:
        ValueError: not even the minimum fits.
    """
    room = ((memory_bytes - IDLE_BYTES) // (_CORRECTION_BYTES_PER_PX * width) - halo_lines) / lines_per_row
    rows = min(_MIN_ROWS, most)
    if room < rows:
        needed = IDLE_BYTES + round(rows * lines_per_row + halo_lines) * width * _CORRECTION_BYTES_PER_PX
        raise ValueError(
            f"a worker needs {needed >> 20} MB for {rows} rows of {width} px, it may take {memory_bytes >> 20} MB"
        )
    if room >= most:
        return most
    while 2 * rows <= room:
        rows *= 2
    return rows


def _strip_rows(scan: Scan, frame: ProductFrame, grid: ProductGrid, processing: Processing) -> int:
    """Rows of a product's strips; checks that matching fits the memory of a worker too."""
    config, limit_mb = processing.correction, processing.worker_memory_mb
    memory_bytes = psutil.virtual_memory().total if limit_mb is None else limit_mb * 2**20
    needed = _matching_bytes(scan, processing.disparity) if isinstance(scan.images, StereoPair) else 0
    if limit_mb is not None and needed > memory_bytes:
        problem = f"matching its strips needs {needed >> 20} MB, a worker may take {limit_mb} MB"
        raise FileFormatError(scan.path, problem)
    # Lines grow evenly with the rows; what is there beyond is the skew of a line.
    most, least = config.strip_rows, min(_MIN_ROWS, config.strip_rows)
    lines_of_least, lines_of_most = (most_lines(frame, grid, config, rows) for rows in (least, most))
    lines_per_row = max(1.0, (lines_of_most - lines_of_least) / max(most - least, 1))
    halo, width = max(lines_of_least - least * lines_per_row, 0), max(scan.rig.width_px, grid.columns)
    try:
        return rows_for_memory(width, halo, most, memory_bytes, lines_per_row=lines_per_row)
    except ValueError as error:
        raise FileFormatError(scan.path, str(error)) from error


def _matching_bytes(scan: Scan, config: DisparityConfig) -> int:
    low, high = disparity_range(scan.rig, config)
    config = config.for_width(scan.rig.width_px)
    lines = config.block_lines + 2 * (config.halo_lines or 0)
    return IDLE_BYTES + scan.rig.width_px * (lines * _MATCHING_BYTES_PER_PX + _COST_BYTES_PER_PX * (high - low))
