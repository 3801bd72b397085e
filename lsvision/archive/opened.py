"""The scans that a worker has open: kept for the next piece of work, dropped where their files have changed."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import torch

from lsvision.archive.identity import ScanFiles
from lsvision.errors import ScanChangedError
from lsvision.image.stereo.relation import PairRelation
from lsvision.io import read_scan
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of, relation_of_scan
from lsvision.types import DepthSource, Scan

latest = threading.local()  # what each thread keeps open itself


@contextmanager
def planned_files(files: ScanFiles) -> Iterator[None]:
    """Read a scan within the block; an error where it was not the planned one before and after.

    What was kept of it in memory is dropped then: it may be of either content.
    """
    try:
        files.check_unchanged()
        try:
            yield
        finally:
            files.check_unchanged()  # what was wrong with the files is the change's fault then
    except ScanChangedError:
        forget()
        raise


def forget() -> None:
    """Drop what is open, of every thread."""
    global latest
    open_scan.cache_clear()
    open_relation.cache_clear()
    latest = threading.local()


# Neighbouring strips of a scan share the parts of the files that were decoded last.
@lru_cache(maxsize=2)
def open_scan(files: ScanFiles) -> Scan:
    """Open a scan.

    Raises:
        ScanChangedError: it has another length than was planned.
    """
    scan = read_scan(files.path, repair_encoder=files.repair_encoder, missing_lines=files.missing_lines)
    if scan.lines != files.lines:
        raise ScanChangedError(files.path)
    return scan


def open_depth(files: ScanFiles, config: DisparityConfig) -> DepthSource:
    """The depth of a scan: its own, or matched where it is read."""
    n = None if files.n is None else torch.tensor(files.n, dtype=torch.float64)
    return depth_of(open_scan(files), config, open_relation(files, config), n)


# Measuring it anew for each strip would cost a tenth of matching.
@lru_cache(maxsize=2)
def open_relation(files: ScanFiles, config: DisparityConfig) -> PairRelation | None:
    """How the two images of a scan differ apart from disparity; None for a scan with a depth map."""
    return relation_of_scan(open_scan(files), config)
