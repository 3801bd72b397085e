"""What an engine is, and the one that works on this machine."""

import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType

from lsvision.archive.engines.protocol import MOST_DEATHS, MOST_FAILED_STARTS, Finished
from lsvision.archive.tasks import Task, TaskResult, run_task
from lsvision.errors import LsvisionError

log = logging.getLogger(__name__)


class LocalEngine:
    """Worker processes on this machine.

    Each worker is a pool of its own, so that when one dies it is known which task it was at: the next worker that is
    free takes that up. A worker gets its first task when it has started, so that no task answers for a failed start.
    """

    def __init__(self, workers: int) -> None:
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["__main__", "lsvision.archive.tasks"])
        self._workers = workers
        self._waiting: deque[Task] = deque()
        self._deaths: dict[Task, int] = {}
        self._idle: list[ProcessPoolExecutor] = []
        # What every other worker is at: a task, or its start where that is None.
        self._busy: dict[Future, tuple[Task | None, ProcessPoolExecutor]] = {}
        self._failed_starts = 0
        for _ in range(workers):
            self._start_worker()

    def __enter__(self) -> "LocalEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pool in [*self._idle, *(pool for _, pool in self._busy.values())]:
            pool.shutdown(wait=kind is None, cancel_futures=True)

    @property
    def capacity(self) -> int:
        """A task a worker and as many waiting, so that no worker waits for this process."""
        return 2 * self._workers

    def submit(self, task: Task) -> None:
        """Take a task for the next worker that is free."""
        self._waiting.append(task)
        self._hand_out()

    def collect(self) -> list[Finished]:
        """Wait for a worker to be done with a task.

        Raises:
            LsvisionError: workers do not start.
        """
        while True:
            ready, _ = wait(self._busy, return_when=FIRST_COMPLETED)
            finished = [item for future in ready if (item := self._take(future)) is not None]
            self._hand_out()
            if finished:
                return finished

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            pool = self._idle.pop()
            try:
                future = pool.submit(run_task, self._waiting[0])
            except BrokenProcessPool:  # killed while it had nothing to do
                self._replace(pool)
                continue
            self._busy[future] = self._waiting.popleft(), pool

    def _take(self, future: Future) -> Finished | None:
        task, pool = self._busy.pop(future)
        try:
            result = future.result()
        except BrokenProcessPool:
            self._replace(pool)
            return self._after_death(task)
        self._idle.append(pool)
        if task is None:
            self._failed_starts = 0
            return None
        self._deaths.pop(task, None)
        return task, result

    def _after_death(self, task: Task | None) -> Finished | None:
        if task is None:
            self._failed_starts += 1
            if self._failed_starts > MOST_FAILED_STARTS:
                raise LsvisionError(
                    f"workers do not start: {self._failed_starts} of them ended before their first task"
                )
            return None
        self._deaths[task] = self._deaths.get(task, 0) + 1
        if self._deaths[task] >= MOST_DEATHS:
            return task, TaskResult(error=f"{MOST_DEATHS} workers died at it, of memory or a signal")
        log.warning("a worker died at %s %d of %s; another takes it up", task.stage or "step", task.number, task.scan)
        self._waiting.appendleft(task)
        return None

    def _replace(self, pool: ProcessPoolExecutor) -> None:
        pool.shutdown(wait=False)
        self._start_worker()

    def _start_worker(self) -> None:
        pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_enter_worker)
        self._busy[pool.submit(os.getpid)] = None, pool


def _enter_worker() -> None:
    """Workers end with the run, however that ends, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
