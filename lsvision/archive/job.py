"""The work on one scan: hash, match, correct, finish; each step only where its result is missing."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

from lsvision import __version__
from lsvision.archive.depth_store import create_depth_store, remove_partial_chunks
from lsvision.archive.identity import depth_key, key_of, product_key
from lsvision.archive.ledger import Ledger, ScanRow, Stage, StripRow, measured_cells
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.archive.product import check_own, is_finished, product_layout, product_path
from lsvision.archive.tasks import Outcome, Strip, Task
from lsvision.archive.work import (
    CorrectionInput,
    CorrectStrip,
    FinishProduct,
    HashInput,
    InputHash,
    MatchStrip,
    ProductPlace,
    StripResult,
    Work,
)
from lsvision.errors import NothingMeasuredError
from lsvision.io import create_product, naming_full_disk
from lsvision.stages.correction.uncertainty import drift_per_metre

WORK_FOLDER = ".work"


@dataclass(frozen=True)
class Place:
    """Where a run works: its ledger, its output, and the folder below which depth and unfinished products lie.

    ``keep_depth`` has the matched depth stored, which many workers and later corrections read; without it, depth is
    matched where it is read. ``verify`` asks for every product to be read back before it gets its name.
    """

    ledger: Ledger
    output: Path
    work: Path
    processing: Processing
    keep_depth: bool = True
    verify: bool = False


class ScanJob:
    """The work on one scan, step by step.

    The ledger and the files say what is missing, nothing else: a job goes on where an earlier one of the same scan was
    ended, whenever that was. The ledger's row of the scan says that it is being worked on from here on.
    """

    def __init__(self, planned: PlannedScan, place: Place) -> None:
        self.planned, self._place = planned, place
        known = place.ledger.scan(planned.key)
        calibration = planned.calibration.calibration
        sideways, in_depth = calibration.motion.drift_mm_per_m
        untouched = known is not None and known.stamp == planned.files.stamp
        place.ledger.put_scan(
            ScanRow(
                scan=planned.key,
                path=planned.files.path,
                status="running",
                lines=planned.lines,
                missing_lines=planned.missing_lines,
                stamp=planned.files.stamp,
                input_sha256=known.input_sha256 if known is not None and untouched else "",
                calibration=str(planned.calibration.path),
                calibration_sha256=planned.calibration.sha256,
                config_sha256=place.processing.sha256,
                version=__version__,
                verdict=calibration.verdict,
                sideways_mm_per_m=sideways,
                in_depth_mm_per_m=in_depth,
                drift_sigma_mm_per_m=max(drift_per_metre(calibration.motion)),
            )
        )

    def next_tasks(self) -> list[Task]:
        """Tasks of the first step whose result is missing, to be run in any order and at once; none when all are there.

        Raises:
            ScanChangedError: the scan is not the one that was planned any more.
            FileFormatError: the scan cannot be read any more, or its product would replace that of another scan.
            NothingMeasuredError: less of the product was measured than ``min_measured_share``.
            WriteError: the disk is full.
        """
        tasks = self._hashing() or self._matching() or self._correcting() or self._finishing()
        if tasks:
            self.planned.files.check_unchanged()
        return tasks

    def record(self, task: Task, outcome: Outcome) -> None:
        """Record what came of a task."""
        result = outcome.result
        if isinstance(result, InputHash):
            self._place.ledger.put_scan(replace(self._row, input_sha256=result.sha256))
        if task.strip is not None:
            row = StripRow(
                task.scan, task.strip.stage, task.strip.number, task.strip.key,
                "failed" if outcome.error else "done", outcome.error or "", seconds=outcome.seconds,
            )  # fmt: skip
            if isinstance(result, StripResult):
                cells = result.measured
                row = replace(
                    row, lines=result.lines, measured_cells=cells.count, lowest_mm=cells.lowest_mm,
                    highest_mm=cells.highest_mm,
                )  # fmt: skip
            self._place.ledger.put_strip(row)

    def finish(self) -> ScanRow:
        """Record that the scan is done, and remove what was made on the way, except its depth."""
        self._work.mkdir(parents=True, exist_ok=True)
        for other in self._work.iterdir():
            if other == self._depth_store:
                remove_partial_chunks(other)
            else:
                shutil.rmtree(other, ignore_errors=True)
        strips = self._place.ledger.strips(self.planned.key)
        row = replace(
            self._row,
            status="done",
            seconds=sum(strip.seconds for strip in strips),
            measured_share=self._measured_share(),
        )
        self._place.ledger.put_scan(row)
        return row

    def fail(self, error: str) -> ScanRow:
        """Record why the scan failed; what is done of it is kept."""
        row = replace(self._row, status="failed", error=error)
        self._place.ledger.put_scan(row)
        return row

    def _hashing(self) -> list[Task]:
        if self._row.input_sha256:
            return []
        return [Task(self.planned.key, HashInput(self.planned.files))]

    def _matching(self) -> list[Task]:
        if self._depth_store is None:
            return []
        config, with_sigma = self._place.processing.disparity, self._place.processing.with_sigma
        planned, store = self.planned, self._depth_store
        if not store.is_dir():
            check_own(Path(self._product.final), planned, self._row.input_sha256)
            self._place.ledger.forget_strips(planned.key, "disparity")
            with naming_full_disk(store):
                self._work.mkdir(parents=True, exist_ok=True)
                create_depth_store(store, planned.lines, planned.width, config.work_lines, with_sigma=with_sigma)
        strips = range(-(-planned.lines // config.work_lines))
        work = [MatchStrip(planned.files, number, str(store), config, with_sigma) for number in strips]
        return self._missing("disparity", self._depth_key, work)

    def _correcting(self) -> list[Task]:
        if self._is_renamed():
            return []
        planned, working = self.planned, Path(self._product.working)
        if not working.is_dir():
            check_own(Path(self._product.final), planned, self._row.input_sha256)
            self._place.ledger.forget_strips(planned.key, "product")
            partial = working.with_name(f"{working.name}.partial")
            with naming_full_disk(self._product.final):
                self._work.mkdir(parents=True, exist_ok=True)
                layout = product_layout(planned, self._place.processing, self._row.input_sha256, self._strips_key)
                create_product(partial, layout)
                partial.rename(working)
        motion = planned.calibration.calibration.motion
        n, covariance = tuple(motion.n.tolist()), tuple(map(tuple, motion.covariance.tolist()))
        store = str(self._depth_store) if self._depth_store else None
        source = CorrectionInput(
            planned.files, store, self._place.processing.disparity, n, covariance, planned.correction, planned.grid
        )
        work = [CorrectStrip(source, number, self._product) for number in range(planned.product_strips)]
        return self._missing("product", self._strips_key, work)

    def _finishing(self) -> list[Task]:
        if self._is_renamed():
            return []
        measured, least = self._measured_share(), self.planned.correction.min_measured_share
        if measured < least:
            raise NothingMeasuredError(
                f"{self.planned.files.path}: {measured:.2%} of the product's cells were measured, expected at least "
                f"{least:.2%} (correction.min_measured_share); do height_range_mm and the rig fit the scan?"
            )
        finish = FinishProduct(self._product, self._strips_key, self._measured_cells(), self._place.verify)
        return [Task(self.planned.key, finish)]

    def _is_renamed(self) -> bool:
        """Whether the product has its final name, be it since an earlier run that was ended before it recorded that."""
        strips = self._place.ledger.finished_strips(self.planned.key, "product", self._strips_key)
        if Path(self._product.working).is_dir() or len(strips) < self.planned.product_strips:
            return False
        return is_finished(self._product.final, self._strips_key)

    def _missing(self, stage: Stage, key: str, work: Sequence[Work]) -> list[Task]:
        finished = self._place.ledger.finished_strips(self.planned.key, stage, key)
        return [
            Task(self.planned.key, item, Strip(stage, number, key))
            for number, item in enumerate(work)
            if number not in finished
        ]

    def _measured_cells(self) -> int:
        strips = self._place.ledger.finished_strips(self.planned.key, "product", self._strips_key)
        return measured_cells(strips.values()).count

    def _measured_share(self) -> float:
        return self._measured_cells() / (self.planned.grid.rows * self.planned.grid.columns)

    @property
    def _row(self) -> ScanRow:
        row = self._place.ledger.scan(self.planned.key)
        return row if row is not None else ScanRow(self.planned.key, self.planned.files.path, "running")

    @property
    def _work(self) -> Path:
        return self._place.work / key_of(self.planned.key)[:16]

    # What depends on the scan's hash is asked for only when that is known. The size of what is stored is part of its
    # key: a plan made while the scan changed must not leave stores that do not fit the next.

    @cached_property
    def _depth_key(self) -> str:
        processing, planned = self._place.processing, self.planned
        key = depth_key(self._row.input_sha256, processing.disparity, processing.with_sigma, __version__)
        return key_of(key, planned.lines, planned.width, processing.missing_lines)

    @cached_property
    def _strips_key(self) -> str:
        processing = self._place.processing
        sha256, correction = self.planned.calibration.sha256, processing.correction
        key = product_key(self._depth_key, sha256, correction, processing.repair_encoder)
        return key_of(key, self.planned.correction.strip_rows, asdict(self.planned.grid))

    @property
    def _depth_store(self) -> Path | None:
        """Where the matched depth is stored; None where none is."""
        stored = self.planned.matched and self._place.keep_depth
        return self._work / f"depth-{self._depth_key[:16]}" if stored else None

    @property
    def _product(self) -> ProductPlace:
        working = self._work / f"product-{self._strips_key[:16]}.zarr"
        return ProductPlace(str(working), str(product_path(self._place.output, self.planned.key)))
