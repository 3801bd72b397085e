"""Where the results of a scan lie, and the hash of everything that each depends on.

The size of what is stored is part of its key: a plan made while the scan changed must not leave stores that do not fit
the next.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

from lsvision import __version__
from lsvision.archive.identity import depth_key, key_of, product_key
from lsvision.archive.inspection import inspection_key
from lsvision.archive.line_motion import Origin
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.archive.product import product_path
from lsvision.archive.work import ProductPlace


@dataclass(frozen=True)
class ScanResults:
    """The results of a scan whose files have the hash ``input_sha256``.

    Attributes:
        work: folder of what is made on the way. output: folder of the products.
        keep_depth: whether matched depth is stored though it is read only once.
    """

    planned: PlannedScan
    processing: Processing
    input_sha256: str
    work: Path
    output: Path
    keep_depth: bool

    @cached_property
    def depth_key(self) -> str:
        """That of the depth of its lines."""
        processing, planned = self.processing, self.planned
        key = depth_key(self.input_sha256, processing.disparity, processing.with_sigma, __version__, planned.files.n)
        # Lines of a raw pair are those of one moment: their rows follow the travel.
        travel = () if planned.files.n is None else (processing.repair_encoder,)
        return key_of(key, planned.lines, planned.width, processing.missing_lines, *travel)

    @cached_property
    def line_motion_key(self) -> str:
        """That of its motion from line to line, which does not depend on whether the sigma of the depth is stored."""
        processing, planned = self.processing, self.planned
        depth = depth_key(self.input_sha256, processing.disparity, False, __version__, planned.files.n)
        choice, sha256 = processing.line_motion, planned.calibration.sha256
        return key_of(depth, sha256, choice.key, processing.repair_encoder, processing.missing_lines, planned.lines)

    @cached_property
    def health_key(self) -> str:
        """That of its signals of drift."""
        return key_of("health", self.depth_key, self.planned.calibration.sha256)

    @cached_property
    def product_key(self) -> str:
        """That of the product."""
        processing = self.processing
        sha256, correction = self.planned.calibration.sha256, processing.correction
        key = product_key(self.depth_key, sha256, correction, processing.repair_encoder)
        return key_of(key, self.planned.correction.strip_rows, asdict(self.planned.grid), self.line_motion_key)

    @cached_property
    def surface_key(self) -> str:
        """That of the inspection of its surface."""
        config = self.processing.surface
        assert config is not None
        return key_of("surface", self.product_key, inspection_key(config))

    @property
    def line_motion_origin(self) -> Origin:
        """Where the motion from line to line comes from."""
        return self.processing.line_motion.origin(self.planned.logged)

    @property
    def depth_store(self) -> Path | None:
        """Where the matched depth is stored; None where none is."""
        stored = self.planned.matched and (self.keep_depth or self.line_motion_origin == "measured")
        return self.work / f"depth-{self.depth_key[:16]}" if stored else None

    @property
    def depth_folder(self) -> str | None:
        """The same as plain data, for workers."""
        return None if self.depth_store is None else str(self.depth_store)

    @property
    def line_motion_store(self) -> Path | None:
        """Where the motion from line to line is stored; None where none is corrected."""
        none = self.line_motion_origin == "none"
        return None if none else self.work / f"line_motion-{self.line_motion_key[:16]}.parquet"

    @property
    def product(self) -> ProductPlace:
        """Where the product is written, and where it will lie."""
        working = self.work / f"product-{self.product_key[:16]}.zarr"
        return ProductPlace(str(working), str(product_path(self.output, self.planned.key)))
