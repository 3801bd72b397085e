"""The pieces of work of which products are made: plain data in, plain data out, results in files.

Each writes chunks, or a folder, that no other writes, and the same bits however often and wherever it runs. So a piece
that was lost half-way, or ran twice, does no harm. Each that reads a scan raises where the scan's files were not the
planned ones before and after: what is recorded was made from those.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import torch

from lsvision.archive import opened
from lsvision.archive.depth_store import open_depth_store, remove_partial_chunks, write_depth
from lsvision.archive.identity import ScanFiles
from lsvision.archive.line_motion import open_line_motion
from lsvision.archive.opened import open_depth, open_scan, planned_files
from lsvision.archive.product import damage_of, is_finished
from lsvision.errors import LsvisionError, ScanChangedError
from lsvision.io import (
    MeasuredCells,
    ProductRows,
    complete_product,
    naming_full_disk,
    remove_partial_siblings,
    scan_sha256,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import Correction
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import Motion, ProductGrid


class Work(Protocol):
    """A piece of work; equal pieces do the same."""

    def run(self) -> object:
        """Do it and return what came of it."""
        ...


@dataclass(frozen=True)
class ProductPlace:
    """Folder in which a product is written, and the final one that it becomes."""

    working: str
    final: str


@dataclass(frozen=True)
class InputHash:
    """SHA-256 of a scan's files."""

    input_sha256: str


@dataclass(frozen=True)
class StripResult:
    """Lines of a strip, or rows of a product, and those of its cells that were measured."""

    lines: int
    measured: MeasuredCells


@dataclass(frozen=True)
class ProductState:
    """What is wrong with a product on disk, in words; empty where nothing is."""

    damage: str


@dataclass(frozen=True)
class HashInput:
    """Hashes a scan's files."""

    scan: ScanFiles

    def run(self) -> InputHash:
        """Read every byte."""
        with planned_files(self.scan):
            return InputHash(scan_sha256(self.scan.path))


@dataclass(frozen=True)
class MatchStrip:
    """Matches one strip of a scan into its chunks of the depth store, with the standard deviation if asked for."""

    scan: ScanFiles
    number: int
    depth_store: str
    config: DisparityConfig
    with_sigma: bool

    def run(self) -> StripResult:
        """Match the strip."""
        start = self.number * self.config.work_lines
        stop = min(start + self.config.work_lines, self.scan.lines)
        with planned_files(self.scan):
            depth = open_depth(self.scan, self.config).read(start, stop)
        with naming_full_disk(self.depth_store):
            write_depth(self.depth_store, start, depth, with_sigma=self.with_sigma)
        return StripResult(stop - start, MeasuredCells(int(torch.isfinite(depth.z).sum())))


@dataclass(frozen=True)
class CorrectionInput:
    """What the strips of a product are corrected from.

    Where there is no store of the depth, it is the scan's own, or matched where it is read. ``line_motion`` is
    the store of that and its hash; None where none is corrected.
    """

    scan: ScanFiles
    depth_store: str | None
    disparity: DisparityConfig
    n: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    config: CorrectionConfig
    grid: ProductGrid
    line_motion: tuple[str, str] | None = None


@dataclass(frozen=True)
class CorrectStrip:
    """Corrects one strip of rows of a product into its chunks."""

    source: CorrectionInput
    number: int
    product: ProductPlace

    def run(self) -> StripResult:
        """Correct the rows."""
        step, rows = self.source.config.strip_rows, self.source.grid.rows
        start = self.number * step
        with planned_files(self.source.scan):
            strip = _open_correction(self.source).strip((start, min(start + step, rows)))
        with naming_full_disk(self.product.final):
            _open_product(self.product.working).write(strip)
        return StripResult(len(strip.height), MeasuredCells.of(strip.height, strip.valid))


@dataclass(frozen=True)
class FinishProduct:
    """Gives a product whose strips are all written its final name, after reading it back where ``verify`` asks for it.

    ``key`` is the one in its metadata, ``measured_cells`` the number of measured cells in its strips.
    """

    product: ProductPlace
    key: str
    measured_cells: int
    verify: bool

    def run(self) -> None:
        """Remove what killed workers left, check, rename."""
        working, final = self.product.working, self.product.final
        remove_partial_siblings(final)
        if not Path(working).is_dir() and is_finished(final, self.key):
            return  # by a worker that crashed before its outcome was known
        remove_partial_chunks(working)
        if self.verify and (damage := damage_of(working, self.measured_cells)):
            raise LsvisionError(damage)
        complete_product(working, final)


@dataclass(frozen=True)
class VerifyProduct:
    """Reads a finished product back."""

    product: str
    measured_cells: int

    def run(self) -> ProductState:
        """Read every row."""
        return ProductState(damage_of(self.product, self.measured_cells))


def _open_correction(source: CorrectionInput) -> Correction:
    """The latest of the thread stays open: neighbouring strips see the same lines at their seam."""
    latest = opened.latest
    if getattr(latest, "source", None) != source:
        scan = open_scan(source.scan)
        depth = (
            open_depth_store(source.depth_store) if source.depth_store else open_depth(source.scan, source.disparity)
        )
        motion = Motion(*(torch.tensor(values, dtype=torch.float64) for values in (source.n, source.covariance)))
        if plan_product(scan, motion, source.config) != source.grid:
            raise ScanChangedError(source.scan.path)
        shaken = open_line_motion(*source.line_motion, scan) if source.line_motion else None
        latest.correction = Correction(scan, depth, motion, source.config, source.grid, shaken)
        latest.source = source
    correction: Correction = latest.correction
    return correction


# Opening costs as much as computing a small strip; folders of one name are always laid out alike.
@lru_cache(maxsize=2)
def _open_product(path: str) -> ProductRows:
    return ProductRows(path)
