"""The pieces of work that workers do, wherever they run: plain data in, plain data out, results in files.

Each writes a chunk, or a folder, of its own, and the same bits however often and wherever it runs. So a piece that was
lost half-way, or ran twice, does no harm.
"""

import dataclasses
import logging
import shutil
import time
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
import zarr
from zarr.codecs import ZstdCodec

from lsvision.errors import FileFormatError, LsvisionError
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import (
    ProductRows,
    check_product,
    complete_product,
    open_line_image,
    read_product,
    read_scan,
    remove_left_over,
    scan_sha256,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import Correction
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import Motion, Scan, StoredDepth

# The arrays of the working store.
DEPTH, SIGMA = "depth.zarr", "sigma.zarr"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScanFiles:
    """A scan on disk as every worker opens it; ``stamp`` tells it from what lay there before."""

    path: str
    stamp: str
    repair_encoder: bool


@dataclass(frozen=True)
class TaskResult:
    """What a task says back: how long it took, over how many lines, what it counted or found, or why it failed."""

    seconds: float = 0.0
    lines: int = 0
    measured: int = 0
    value: str = ""
    error: str | None = None


@dataclass(frozen=True)
class HashInput:
    """The SHA-256 of a scan's files, as ``value``."""

    scan: ScanFiles

    def run(self) -> TaskResult:
        """Read every byte."""
        return TaskResult(value=scan_sha256(self.scan.path))


@dataclass(frozen=True)
class MatchStrip:
    """The depth of one strip of a scan, with its standard deviation if asked to, into chunks of the working store."""

    scan: ScanFiles
    number: int
    depth: str
    config: DisparityConfig
    with_sigma: bool

    def run(self) -> TaskResult:
        """Match the strip."""
        scan = _open_scan(self.scan)
        start = self.number * self.config.work_lines
        stop = min(start + self.config.work_lines, scan.lines)
        depth = depth_of(scan, self.config).read(start, stop)
        _open_array(f"{self.depth}/{DEPTH}")[start:stop] = depth.z.numpy()
        if self.with_sigma and depth.sigma is not None:
            _open_array(f"{self.depth}/{SIGMA}")[start:stop] = depth.sigma.numpy()
        return TaskResult(lines=stop - start, measured=int(torch.isfinite(depth.z).sum()))


@dataclass(frozen=True)
class CorrectStrip:
    """One strip of rows of a product, into its chunks; ``depth`` is the working store, the scan's own where None."""

    scan: ScanFiles
    number: int
    depth: str | None
    product: str
    n: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    config: CorrectionConfig

    def run(self) -> TaskResult:
        """Correct the rows."""
        scan = _open_scan(self.scan)
        depth = depth_of(scan) if self.depth is None else _open_depth(self.depth)
        motion = Motion(*(torch.tensor(values, dtype=torch.float64) for values in (self.n, self.covariance)))
        grid = plan_product(scan, motion, self.config)
        first = self.number * self.config.strip_rows
        rows = first, min(first + self.config.strip_rows, grid.rows)
        strip = Correction(scan, depth, motion, self.config, grid).strip(rows)
        _open_product(self.product).write(strip.row, strip.color, strip.height, strip.valid, strip.source, strip.sigma)
        return TaskResult(lines=rows[1] - rows[0], measured=int(strip.valid.sum()))


@dataclass(frozen=True)
class FinishProduct:
    """Gives a product whose strips are all written its final name, after reading it back where asked to.

    ``key`` is the one in its metadata, ``measured`` the number of valid cells that its strips were written with.
    """

    product: str
    target: str
    key: str
    measured: int
    verify: bool

    def run(self) -> TaskResult:
        """Take away what killed workers left, check, rename."""
        remove_left_over(self.target)
        if not Path(self.product).is_dir() and is_finished(self.target, self.key):
            return TaskResult()  # by a worker that died before it could say so
        remove_partial_chunks(self.product)
        if self.verify and (damage := damage_of(self.product, self.measured)):
            return TaskResult(error=damage)
        complete_product(self.product, self.target)
        return TaskResult()


@dataclass(frozen=True)
class VerifyProduct:
    """Reads a finished product; what is wrong with it is the ``value``, empty where nothing is."""

    target: str
    measured: int

    def run(self) -> TaskResult:
        """Read every row."""
        return TaskResult(value=damage_of(self.target, self.measured))


Work = HashInput | MatchStrip | CorrectStrip | FinishProduct | VerifyProduct


@dataclass(frozen=True)
class Task:
    """A piece of work for a scan of the archive; where it is a strip, what the ledger files it under."""

    scan: str
    work: Work
    stage: Literal["disparity", "product"] | None = None
    number: int = 0
    key: str = ""


def run_task(task: Task) -> TaskResult:
    """Do a piece of work on one thread; whatever is wrong with its data is its result, never an exception."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _keep_freed_memory()
    begin = time.perf_counter()
    try:
        result = task.work.run()
    except LsvisionError as error:
        return TaskResult(error=str(error))
    except OSError as error:
        return TaskResult(error=f"{error.filename or task.work}: {error.strerror}")
    except Exception as error:  # one scan's fault, of whatever kind, must not end the others
        log.exception("%s", task)
        return TaskResult(error=f"{type(error).__name__}: {error}")
    return dataclasses.replace(result, seconds=time.perf_counter() - begin)


def create_depth_store(path: Path, lines: int, width: int, strip_lines: int, *, with_sigma: bool) -> None:
    """Lay out an empty store of depth, float32 mm, NaN for none, a chunk a strip; it is there whole or not at all."""
    partial = path.with_name(f"{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    for name in (DEPTH, SIGMA) if with_sigma else (DEPTH,):
        zarr.create_array(
            partial / name,
            shape=(lines, width),
            chunks=(min(strip_lines, lines), width),
            dtype=np.float32,
            fill_value=np.nan,
            compressors=[ZstdCodec(level=1, checksum=True)],
        )
    partial.rename(path)


def remove_partial_chunks(store: Path | str) -> None:
    """Take away what workers left that were killed while they wrote a chunk; for the only one who uses the store."""
    for left_over in Path(store).rglob("*.partial"):
        left_over.unlink(missing_ok=True)


def is_finished(target: Path | str, key: str) -> bool:
    """Whether the product of this key has its final name already."""
    try:
        return read_product(target).metadata.get("key") == key
    except FileFormatError:
        return False


def damage_of(path: str, measured: int) -> str:
    """What is wrong with a product on disk, in words; empty where it reads and has the cells it was written with."""
    try:
        check = check_product(path)
    except FileFormatError as error:
        return str(error)
    found = round(check.valid_share * check.rows * check.columns)
    return "" if found == measured else f"{path}: expected {measured} measured cells, found {found}"


_keep_freed_memory = cache(keep_freed_memory)  # once a process


# Neighbouring strips of a scan share the parts of the files that were decoded last.
@lru_cache(maxsize=2)
def _open_scan(files: ScanFiles) -> Scan:
    return read_scan(files.path, repair_encoder=files.repair_encoder)


@lru_cache(maxsize=2)
def _open_depth(path: str) -> StoredDepth:
    sigma = Path(path, SIGMA)
    return StoredDepth(open_line_image(Path(path, DEPTH)), open_line_image(sigma) if sigma.is_dir() else None)


# Opening costs as much as computing a small strip; a folder of one name is always laid out the same.
@lru_cache(maxsize=2)
def _open_product(path: str) -> ProductRows:
    return ProductRows(path)


@lru_cache(maxsize=4)
def _open_array(path: str) -> Any:
    return zarr.open_array(path, mode="r+")
