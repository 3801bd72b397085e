"""The archive of one scan, worked through in this process."""

import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from lsvision.archive.driver import Progress, process_scans
from lsvision.archive.engines.in_process import InProcessEngine
from lsvision.archive.identity import key_of, stamp_of
from lsvision.archive.job import WORK_FOLDER, Place
from lsvision.archive.ledger import LEDGER_FILE, Ledger, measured_cells
from lsvision.archive.lock import lock_if_free, sole_run
from lsvision.archive.planned import PlannedScan, Processing, plan_scan
from lsvision.archive.product import product_path
from lsvision.archive.sources.calibrations import read_calibrations
from lsvision.archive.sources.catalogue import SCAN_FILE, Found, name_problem
from lsvision.errors import LsvisionError
from lsvision.io import MeasuredCells
from lsvision.types import RefusedVerdict

_ABANDONED = "abandoned"  # work folders on their way out


@dataclass(frozen=True)
class FinishedProduct:
    """A product on disk and the cells that were measured of it."""

    path: Path
    measured: MeasuredCells


def plan_one(
    scan: Path | str, calibration: Path | str, processing: Processing, accept: Sequence[RefusedVerdict] = ()
) -> PlannedScan:
    """Plan the product of one scan, which is named after its folder.

    Args:
        scan: the scan's folder, or its ``scan.yaml``.
        calibration: its calibration, or a folder of several to choose from by rig and date.
        accept: see ``read_calibrations``.

    Raises:
        LsvisionError: see ``plan_scan`` and ``read_calibrations``.
    """
    folder = Path(scan).parent if Path(scan).name == SCAN_FILE else Path(scan)
    found = Found(folder.resolve().name, folder.absolute(), name_problem(str(folder.absolute())))
    if found.problem is None:
        stamp_of(found.path)  # of two missing files, the scan is named first
    return plan_scan(found, read_calibrations(calibration, accept), processing)


def process_one(planned: PlannedScan, processing: Processing, output: Path, progress: Progress) -> FinishedProduct:
    """Make the product of one scan in this process, on as many threads as torch may use.

    The ledger and everything else but the product is hidden in the output while the work goes on, and removed at its
    end. A run that was interrupted or killed leaves it; the next of the same scan goes on from there, one of another
    scan into this output removes it.

    Args:
        progress: called with every finished task and its outcome.

    Raises:
        LsvisionError: the product cannot be made; nothing of it is left.
    """
    work = output / WORK_FOLDER / f"correct-{key_of(planned.files.path)[:16]}"
    lock = work.with_suffix(".lock")
    with sole_run(output, lock), _temporary(work, lock):
        _remove_abandoned(work)
        with Ledger(work / LEDGER_FILE) as ledger, InProcessEngine() as engine:
            place = Place(ledger, output, work, processing, keep_depth=False)
            (row,) = process_scans([planned], engine, place, progress)
            measured = measured_cells(strip for strip in ledger.strips(planned.key) if strip.stage == "product")
        if row.status == "failed":
            raise LsvisionError(row.error)
    return FinishedProduct(product_path(output, planned.key), measured)


def _remove_abandoned(own: Path) -> None:
    """Remove what killed runs of other scans left beside a run's own folder; those at work hold their locks.

    A run of such a scan may start meanwhile: its lock is held no longer than it takes to give the folder another name.
    """
    others = {path.with_suffix("") for path in own.parent.glob("correct-*")} - {own}
    for folder in others:
        lock = folder.with_suffix(".lock")
        with lock_if_free(lock) as free:
            if free:
                with suppress(OSError):
                    folder.rename(own.parent / f"{_ABANDONED}-{uuid.uuid4().hex}")
                with suppress(OSError):
                    lock.unlink()
    for folder in own.parent.glob(f"{_ABANDONED}-*"):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _temporary(folder: Path, lock: Path) -> Iterator[None]:
    """Create a folder for the block and remove it and its lock after it; an interrupted block leaves the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except LsvisionError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    else:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        with suppress(OSError):  # where open files cannot be removed, or others work beside it
            lock.unlink()
            folder.parent.rmdir()
