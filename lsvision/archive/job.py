"""What has to happen to one scan, step by step, given what the ledger says was done before."""

import shutil
from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from lsvision import __version__
from lsvision.archive.identity import disparity_key, key_of, product_key
from lsvision.archive.ledger import Ledger, ScanRow, Stage
from lsvision.archive.plan import PlannedScan, Processing, product_path
from lsvision.archive.tasks import (
    CorrectStrip,
    FinishProduct,
    HashInput,
    MatchStrip,
    ScanFiles,
    Task,
    TaskResult,
    VerifyProduct,
    Work,
    create_depth_store,
    is_finished,
    remove_partial_chunks,
)
from lsvision.geometry import ProductFrame
from lsvision.io import ProductLayout, create_product, read_scan
from lsvision.types import Scan

WORK_FOLDER = ".work"

# A job yields tasks that may run in any order and at once, and is sent their results when all of them are done.
Job = Generator[list[Task], Sequence[TaskResult], ScanRow]


@dataclass(frozen=True)
class Place:
    """Where a run works: its ledger, its output, what it does to every scan, and whether products are read back."""

    ledger: Ledger
    output: Path
    processing: Processing
    verify: bool


def scan_job(planned: PlannedScan, place: Place) -> Job:
    """Hash, match, correct, finish: every step only where its result is not there already.

    Returns:
        The scan's row for the ledger.
    """
    row = _first_row(planned, place)
    if not row.input_sha256:
        (hashed,) = yield [Task(planned.key, HashInput(_files(planned, place)))]
        row = replace(row, input_sha256=hashed.value)
    place.ledger.put_scan(row)
    work = place.output / WORK_FOLDER / key_of(planned.key)[:16]
    work.mkdir(parents=True, exist_ok=True)
    processing = place.processing
    depth_key = disparity_key(row.input_sha256, processing.disparity, processing.with_sigma, __version__)
    depth = work / f"depth-{depth_key[:16]}" if planned.matched else None
    if depth is not None:
        yield _matching(planned, place, depth, depth_key)

    key = product_key(depth_key, planned.calibration.sha256, processing.correction, processing.repair_encoder)
    strips_key = key_of(key, planned.correction.strip_rows)
    product, target = work / f"product-{strips_key[:16]}.zarr", product_path(place.output, planned.key)
    if not _is_renamed(planned, place, product, target, strips_key):
        yield _correcting(planned, place, depth, product, strips_key)
        measured = sum(strip.measured for strip in place.ledger.done(planned.key, "product", strips_key).values())
        yield [Task(planned.key, FinishProduct(str(product), str(target), strips_key, measured, place.verify))]
    for other in work.iterdir():
        if other == depth:
            remove_partial_chunks(other)
        else:
            shutil.rmtree(other, ignore_errors=True)
    return _last_row(row, planned, place, strips_key)


def verify_job(planned: PlannedScan, place: Place) -> Job:
    """Read an unchanged scan's product back, and make it anew where it is damaged."""
    row = place.ledger.scan(planned.key)
    measured = sum(strip.measured for strip in place.ledger.strips(planned.key) if strip.stage == "product")
    target = product_path(place.output, planned.key)
    (checked,) = yield [Task(planned.key, VerifyProduct(str(target), measured))]
    if row is not None and not checked.value:
        return row
    place.ledger.forget_strips(planned.key, "product")
    return (yield from scan_job(planned, place))


def _matching(planned: PlannedScan, place: Place, depth: Path, key: str) -> list[Task]:
    config, with_sigma = place.processing.disparity, place.processing.with_sigma
    if not depth.is_dir():
        place.ledger.forget_strips(planned.key, "disparity")
        create_depth_store(depth, planned.lines, planned.width, config.work_lines, with_sigma=with_sigma)
    count = -(-planned.lines // config.work_lines)
    files = _files(planned, place)
    work = [MatchStrip(files, number, str(depth), config, with_sigma) for number in range(count)]
    return _missing(planned, place, "disparity", key, work)


def _correcting(planned: PlannedScan, place: Place, depth: Path | None, product: Path, key: str) -> list[Task]:
    if not product.is_dir():
        place.ledger.forget_strips(planned.key, "product")
        scan = read_scan(planned.path, repair_encoder=place.processing.repair_encoder)
        partial = product.with_name(f"{product.name}.partial")
        create_product(partial, _layout(planned, place, scan, key))
        partial.rename(product)
    motion = planned.calibration.calibration.motion
    n, covariance = tuple(motion.n.tolist()), tuple(map(tuple, motion.covariance.tolist()))
    files, store = _files(planned, place), str(depth) if depth else None
    count = -(-planned.grid.rows // planned.correction.strip_rows)
    work = [
        CorrectStrip(files, number, store, str(product), n, covariance, planned.correction) for number in range(count)
    ]
    return _missing(planned, place, "product", key, work)


def _missing(planned: PlannedScan, place: Place, stage: Stage, key: str, work: Sequence[Work]) -> list[Task]:
    done = place.ledger.done(planned.key, stage, key)
    return [Task(planned.key, item, stage, number, key) for number, item in enumerate(work) if number not in done]


def _is_renamed(planned: PlannedScan, place: Place, product: Path, target: Path, key: str) -> bool:
    """Whether an earlier run was ended between giving the product its name and saying so in the ledger."""
    count = -(-planned.grid.rows // planned.correction.strip_rows)
    if product.is_dir() or len(place.ledger.done(planned.key, "product", key)) < count:
        return False
    return is_finished(target, key)


def _layout(planned: PlannedScan, place: Place, scan: Scan, key: str) -> ProductLayout:
    motion, grid = planned.calibration.calibration.motion, planned.grid
    return ProductLayout(
        shape=(grid.rows, grid.columns),
        pitch_mm=grid.pitch_mm,
        origin_mm=(grid.origin_y_mm, grid.origin_x_mm),
        channels=scan.left.shape[2],
        dtype=scan.left.dtype,
        chunk_rows=planned.correction.strip_rows,
        metadata={
            "scan": str(planned.path),
            "version": __version__,
            "n": motion.n.tolist(),
            "height_datum_mm": ProductFrame(scan.rig, scan.travel, motion.n).height_datum_mm,
            "attributes": dict(scan.attributes),
            "calibration": str(planned.calibration.path),
            "disparity": asdict(place.processing.disparity),
            "correction": asdict(planned.correction),
            "key": key,
        },
        uncertainty=planned.correction.uncertainty,
    )


def _files(planned: PlannedScan, place: Place) -> ScanFiles:
    return ScanFiles(str(planned.path), planned.stamp, place.processing.repair_encoder)


def _first_row(planned: PlannedScan, place: Place) -> ScanRow:
    """The row of a scan that is being worked on; files that nobody touched keep their hash."""
    known = place.ledger.scan(planned.key)
    return ScanRow(
        scan=planned.key,
        path=str(planned.path),
        status="running",
        lines=planned.lines,
        stamp=planned.stamp,
        input_sha256=known.input_sha256 if known is not None and known.stamp == planned.stamp else "",
        calibration=str(planned.calibration.path),
        calibration_sha256=planned.calibration.sha256,
        config_sha256=place.processing.sha256,
        version=__version__,
    )


def _last_row(row: ScanRow, planned: PlannedScan, place: Place, key: str) -> ScanRow:
    strips = place.ledger.strips(planned.key)
    measured = sum(strip.measured for strip in strips if strip.key == key)
    return replace(
        row,
        status="done",
        seconds=sum(strip.seconds for strip in strips),
        measured=measured / (planned.grid.rows * planned.grid.columns),
    )
