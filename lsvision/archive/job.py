"""The work on one scan: hash, match, find the line motion, correct, finish, inspect; each step without a result yet."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from lsvision.archive.depth_store import create_depth_store, remove_partial_chunks
from lsvision.archive.health import MeasureHealth, ScanHealth
from lsvision.archive.identity import key_of
from lsvision.archive.inspection import InspectProduct, is_inspected
from lsvision.archive.ledger import Ledger, ScanRow, Stage, measured_cells
from lsvision.archive.line_motion import FindLineMotion, StoredLineMotion
from lsvision.archive.planned import PlannedScan, Processing
from lsvision.archive.product import check_own, is_finished, product_layout
from lsvision.archive.results import ScanResults
from lsvision.archive.rows import finished_row, running_row, strip_row
from lsvision.archive.tasks import Outcome, Strip, Task
from lsvision.archive.work import (
    CorrectionInput,
    CorrectStrip,
    FinishProduct,
    HashInput,
    InputHash,
    MatchStrip,
    Work,
)
from lsvision.errors import FileFormatError, NothingMeasuredError
from lsvision.io import create_product, naming_full_disk

WORK_FOLDER = ".work"


@dataclass(frozen=True)
class Place:
    """Where a run works: its ledger, its output, and the folder below which depth and unfinished products lie.

    ``keep_depth`` has the matched depth stored, which many workers and later corrections read; without it, depth is
    matched where it is read. ``verify`` has every product read back before it gets its name, ``watch`` drift measured.
    """

    ledger: Ledger
    output: Path
    work: Path
    processing: Processing
    keep_depth: bool = True
    verify: bool = False
    watch: bool = False


class ScanJob:
    """The work on one scan, step by step.

    The ledger and the files say what is missing, nothing else: a job goes on where an earlier one of the same scan was
    ended, whenever that was. The ledger's row of the scan says that it is being worked on from here on.
    """

    def __init__(self, planned: PlannedScan, place: Place) -> None:
        self.planned, self._place = planned, place
        known = place.ledger.scan(planned.key)
        place.ledger.put_scan(running_row(planned, place.processing, known))

    def next_tasks(self) -> list[Task]:
        """Tasks of the first step whose result is missing, to be run in any order and at once; none when all are there.

        Raises:
            ScanChangedError: the scan is not the one that was planned any more.
            FileFormatError: the scan cannot be read any more, or its product would replace that of another scan.
            NothingMeasuredError: less of the product was measured than ``min_measured_share``.
            WriteError: the disk is full.
        """
        tasks = (
            self._hashing()
            or self._matching()
            or self._finding_line_motion()
            or self._watching()
            or self._correcting()
            or self._finishing()
            or self._inspecting()
        )
        if tasks:
            self.planned.files.check_unchanged()
        return tasks

    def record(self, task: Task, outcome: Outcome) -> None:
        """Record what came of a task."""
        result = outcome.result
        if isinstance(result, InputHash | ScanHealth):
            self._place.ledger.put_scan(replace(self._row, **asdict(result)))
        if (row := strip_row(task, outcome)) is not None:
            self._place.ledger.put_strip(row)

    def finish(self) -> ScanRow:
        """Record that the scan is done, and remove what was made on the way, except its depth and line motion."""
        self._work.mkdir(parents=True, exist_ok=True)
        results = self._results
        for other in self._work.iterdir():
            if other == results.depth_store:
                remove_partial_chunks(other)
            elif other.is_dir():
                shutil.rmtree(other, ignore_errors=True)
            elif other != results.line_motion_store:
                other.unlink(missing_ok=True)
        strips = self._place.ledger.strips(self.planned.key)
        row = finished_row(self._row, strips, self._measured_share(), self._line_motion())
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
        results, planned = self._results, self.planned
        store = results.depth_store
        if store is None:
            return []
        config, with_sigma = self._place.processing.disparity, self._place.processing.with_sigma
        if not store.is_dir():
            check_own(Path(results.product.final), planned, results.input_sha256)
            self._place.ledger.forget_strips(planned.key, "disparity")
            with naming_full_disk(store):
                self._work.mkdir(parents=True, exist_ok=True)
                create_depth_store(store, planned.lines, planned.width, config.work_lines, with_sigma=with_sigma)
        strips = range(-(-planned.lines // config.work_lines))
        work = [MatchStrip(planned.files, number, str(store), config, with_sigma) for number in strips]
        return self._missing("disparity", results.depth_key, work)

    def _finding_line_motion(self) -> list[Task]:
        results, planned = self._results, self.planned
        if (store := results.line_motion_store) is None:
            return []
        if self._line_motion() is None:
            check_own(Path(results.product.final), planned, results.input_sha256)
            self._place.ledger.forget_strips(planned.key, "line_motion")
            with naming_full_disk(store):
                self._work.mkdir(parents=True, exist_ok=True)
        config, choice = self._place.processing.disparity, self._place.processing.line_motion
        work = FindLineMotion(planned.files, results.depth_folder, config, planned.n, choice, str(store))
        return self._missing("line_motion", results.line_motion_key, [work])

    def _watching(self) -> list[Task]:
        if not self._place.watch:
            return []
        results, disparity = self._results, self._place.processing.disparity
        work = MeasureHealth(self.planned.files, results.depth_folder, disparity, self.planned.n)
        return self._missing("health", results.health_key, [work])

    def _correcting(self) -> list[Task]:
        if self._is_renamed():
            return []
        planned, results, found = self.planned, self._results, self._line_motion()
        working = Path(results.product.working)
        if not working.is_dir():
            check_own(Path(results.product.final), planned, results.input_sha256)
            self._place.ledger.forget_strips(planned.key, "product")
            partial = working.with_name(f"{working.name}.partial")
            with naming_full_disk(results.product.final):
                self._work.mkdir(parents=True, exist_ok=True)
                layout = product_layout(
                    planned, self._place.processing, results.input_sha256, results.product_key, found
                )
                create_product(partial, layout)
                partial.rename(working)
        line_motion = None if found is None else (str(results.line_motion_store), found.sha256)
        source = CorrectionInput(
            planned.files, results.depth_folder, self._place.processing.disparity, planned.n, planned.covariance,
            planned.correction, planned.grid, line_motion,
        )  # fmt: skip
        work = [CorrectStrip(source, number, results.product) for number in range(planned.product_strips)]
        return self._missing("product", results.product_key, work)

    def _finishing(self) -> list[Task]:
        if self._is_renamed():
            return []
        measured, least = self._measured_share(), self.planned.correction.min_measured_share
        if measured < least:
            raise NothingMeasuredError(
                f"{self.planned.files.path}: {measured:.2%} of the product's cells were measured, expected at least "
                f"{least:.2%} (correction.min_measured_share); do height_range_mm and the rig fit the scan?"
            )
        finish = FinishProduct(
            self._results.product, self._results.product_key, self._measured_cells(), self._place.verify
        )
        return [Task(self.planned.key, finish)]

    def _inspecting(self) -> list[Task]:
        config = self._place.processing.surface
        if config is None:
            return []
        results = self._results
        final, key = results.product.final, results.surface_key
        if not is_inspected(final, key):
            self._place.ledger.forget_strips(self.planned.key, "surface")
        return self._missing("surface", key, [InspectProduct(final, config, key)])

    def _line_motion(self) -> StoredLineMotion | None:
        """What was found of the motion from line to line; None where none is corrected or the file is not whole."""
        results = self._results
        if results.line_motion_store is None:
            return None
        try:
            return StoredLineMotion.read(results.line_motion_store, results.line_motion_origin, self.planned.lines)
        except FileFormatError:
            return None

    def _is_renamed(self) -> bool:
        """Whether the product has its final name, be it since an earlier run that was ended before it recorded that."""
        strips = self._place.ledger.finished_strips(self.planned.key, "product", self._results.product_key)
        if Path(self._results.product.working).is_dir() or len(strips) < self.planned.product_strips:
            return False
        return is_finished(self._results.product.final, self._results.product_key)

    def _missing(self, stage: Stage, key: str, work: Sequence[Work]) -> list[Task]:
        finished = self._place.ledger.finished_strips(self.planned.key, stage, key)
        return [
            Task(self.planned.key, item, Strip(stage, number, key))
            for number, item in enumerate(work)
            if number not in finished
        ]

    def _measured_cells(self) -> int:
        strips = self._place.ledger.finished_strips(self.planned.key, "product", self._results.product_key)
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

    @property
    def _results(self) -> ScanResults:
        """What depends on the scan's hash is asked for only when that is known."""
        row, place = self._row, self._place
        return ScanResults(self.planned, place.processing, row.input_sha256, self._work, place.output, place.keep_depth)
