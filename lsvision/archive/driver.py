"""Driving the jobs of many scans through an engine, with the ledger kept by this process alone."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from lsvision.archive.engines.protocol import Engine
from lsvision.archive.job import Job, Place
from lsvision.archive.ledger import ScanRow, StripRow
from lsvision.archive.tasks import Task, TaskResult
from lsvision.errors import LsvisionError

# Called with the task that was done and its result.
Progress = Callable[[Task, TaskResult], None]


@dataclass
class _Running:
    """A job between two steps: tasks of the present one that wait, how many are out, and what came back."""

    key: str
    job: Job
    waiting: deque[Task] = field(default_factory=deque)
    out: int = 0
    results: dict[Task, TaskResult] = field(default_factory=dict)
    step: Sequence[Task] = ()
    error: str | None = None


def run_jobs(jobs: Iterable[tuple[str, Job]], engine: Engine, place: Place, progress: Progress) -> list[ScanRow]:
    """Take every job to its end, a few scans at a time and the first of them first; one that fails ends alone.

    Args:
        jobs: key of the scan and its job, asked for as there is room.
        progress: told of every task that is done.

    Returns:
        The rows of the scans, as the ledger now has them.
    """
    coming, out = iter(jobs), 0
    active: dict[str, _Running] = {}
    finished: list[ScanRow] = []
    while True:
        while out < engine.capacity:
            task = next((run.waiting.popleft() for run in active.values() if run.waiting), None)
            if task is not None:
                active[task.scan].out += 1
                out += 1
                engine.submit(task)
                continue
            following = next(coming, None)
            if following is None:
                break
            run = _Running(*following)
            row = _advance(run, place, None)
            if row is not None:
                finished.append(row)
            else:
                active[run.key] = run
        if not out:
            return finished
        for task, result in engine.collect():
            out -= 1
            progress(task, result)
            run = active[task.scan]
            row = _take(run, place, task, result)
            if row is not None:
                finished.append(row)
                del active[run.key]


def _take(run: _Running, place: Place, task: Task, result: TaskResult) -> ScanRow | None:
    """Book a result; the scan's row where that ends its job."""
    run.out -= 1
    run.results[task] = result
    if task.stage is not None:
        place.ledger.put_strip(
            StripRow(
                task.scan, task.stage, task.number, task.key, "failed" if result.error else "done",
                result.error or "", result.lines, result.seconds, result.measured,
            )
        )  # fmt: skip
    if result.error is not None and run.error is None:
        run.error = result.error if task.stage is None else f"{task.stage} strip {task.number}: {result.error}"
        run.waiting.clear()
    if run.out or run.waiting:
        return None
    if run.error is not None:
        run.job.close()
        return _failed(run.key, place, run.error)
    return _advance(run, place, [run.results[task] for task in run.step])


def _advance(run: _Running, place: Place, results: Sequence[TaskResult] | None) -> ScanRow | None:
    """Send a job the results of its step and take its next one; its row where there is none."""
    try:
        step = next(run.job) if results is None else run.job.send(results)
        while not step:
            step = run.job.send([])
    except StopIteration as end:
        row: ScanRow = end.value
        place.ledger.put_scan(row)
        return row
    except (LsvisionError, OSError) as error:
        return _failed(run.key, place, str(error))
    run.step, run.waiting, run.results = step, deque(step), {}
    return None


def _failed(key: str, place: Place, error: str) -> ScanRow:
    row = replace(place.ledger.scan(key) or ScanRow(key, "", "running"), status="failed", error=error)
    place.ledger.put_scan(row)
    return row
