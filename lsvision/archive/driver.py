"""Taking many scans through an engine, with the ledger kept by this process alone."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from lsvision.archive.engines.protocol import Engine, Finished
from lsvision.archive.job import Place, ScanJob
from lsvision.archive.ledger import ScanRow, measured_cells
from lsvision.archive.planned import PlannedScan
from lsvision.archive.product import product_path
from lsvision.archive.tasks import Outcome, Task
from lsvision.archive.work import ProductState, VerifyProduct
from lsvision.errors import LsvisionError

# Called with every finished task and its outcome.
Progress = Callable[[Task, Outcome], None]


@dataclass
class ActiveScan:
    """A scan in the middle of a step: tasks that wait, the number of those the engine has, and the first error."""

    job: ScanJob
    waiting: deque[Task] = field(default_factory=deque)
    submitted: int = 0
    error: str | None = None


class Driver:
    """Takes scans to their end, a few at a time; the tasks of those that started first come first.

    Args:
        progress: called with every finished task, before its outcome is recorded.
    """

    def __init__(self, engine: Engine, place: Place, progress: Progress) -> None:
        self._engine, self._place, self._progress = engine, place, progress
        self._active: dict[str, ActiveScan] = {}
        self._rows: list[ScanRow] = []

    def run(self, scans: Iterable[PlannedScan]) -> list[ScanRow]:
        """Take every scan to its end; one that fails ends alone.

        Args:
            scans: taken one by one, each when the engine has room for more than the tasks that wait.

        Returns:
            The rows of the scans, as the ledger now has them.
        """
        coming = iter(scans)
        while True:
            while self._submitted < self._engine.capacity and (task := self._next_task(coming)) is not None:
                self._active[task.scan].submitted += 1
                self._engine.submit(task)
            if not self._submitted:
                return self._rows
            for task, outcome in self._engine.collect():
                self._progress(task, outcome)
                self._take(self._active[task.scan], task, outcome)

    @property
    def _submitted(self) -> int:
        return sum(scan.submitted for scan in self._active.values())

    def _next_task(self, coming: Iterator[PlannedScan]) -> Task | None:
        """A task of the first scan that has one waiting; the next scan is started where none has."""
        while True:
            for scan in self._active.values():
                if scan.waiting:
                    return scan.waiting.popleft()
            planned = next(coming, None)
            if planned is None:
                return None
            scan = self._active[planned.key] = ActiveScan(ScanJob(planned, self._place))
            self._step(scan)

    def _take(self, scan: ActiveScan, task: Task, outcome: Outcome) -> None:
        """Record an outcome; when it is the last of its step, go on to the next."""
        scan.submitted -= 1
        scan.job.record(task, outcome)
        if outcome.error is not None and scan.error is None:
            where = f"{task.strip.stage} strip {task.strip.number}: " if task.strip else ""
            scan.error = where + outcome.error
            scan.waiting.clear()
        if not scan.submitted and not scan.waiting:
            self._step(scan)

    def _step(self, scan: ActiveScan) -> None:
        """Line up the tasks of a scan's next step, or end it."""
        if scan.error is None:
            try:
                scan.waiting.extend(scan.job.next_tasks())
            except LsvisionError as error:
                scan.error = str(error)
            except OSError as error:
                scan.error = f"{error.filename or scan.job.planned.files.path}: {error.strerror}"
        if not scan.waiting:
            self._rows.append(scan.job.finish() if scan.error is None else scan.job.fail(scan.error))
            del self._active[scan.job.planned.key]


def process_scans(
    scans: Iterable[PlannedScan], engine: Engine, place: Place, progress: Progress = lambda task, outcome: None
) -> list[ScanRow]:
    """Make the products of scans; see ``Driver``."""
    return Driver(engine, place, progress).run(scans)


def damaged_products(scans: Iterable[PlannedScan], engine: Engine, place: Place) -> list[PlannedScan]:
    """The scans whose finished products do not read back; their strips are forgotten, so that they are made anew."""
    by_key = {scan.key: scan for scan in scans}
    damaged = []
    for task, outcome in _run_all((_verification(scan, place) for scan in by_key.values()), engine):
        if outcome.result != ProductState(damage=""):
            place.ledger.forget_strips(task.scan, "product")
            damaged.append(by_key[task.scan])
    return damaged


def _verification(scan: PlannedScan, place: Place) -> Task:
    strips = [strip for strip in place.ledger.strips(scan.key) if strip.stage == "product"]
    return Task(scan.key, VerifyProduct(str(product_path(place.output, scan.key)), measured_cells(strips).count))


def _run_all(tasks: Iterable[Task], engine: Engine) -> Iterator[Finished]:
    """Outcomes of tasks in the order in which they are finished."""
    coming, submitted = iter(tasks), 0
    while True:
        while submitted < engine.capacity and (task := next(coming, None)) is not None:
            engine.submit(task)
            submitted += 1
        if not submitted:
            return
        for finished in engine.collect():
            submitted -= 1
            yield finished
