"""What an engine is, and the one that works on this machine."""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol

from lsvision.archive.tasks import Task, TaskResult, run_task

# A strip that ended this many workers is given up.
MOST_DEATHS = 2

log = logging.getLogger(__name__)

Finished = tuple[Task, TaskResult]


@dataclass(frozen=True)
class EngineConfig:
    """Where strips are computed.

    ``workers`` is as many as cores and memory allow where it is None. ``worker_memory_mb`` bounds what one takes:
    strips are sized by it. ``scheduler`` is the address of a Dask scheduler; a local cluster is started where it is
    None.
    """

    kind: Literal["local", "dask"] = "local"
    workers: int | None = None
    worker_memory_mb: int = 3072
    scheduler: str | None = None


class Engine(Protocol):
    """Runs tasks on workers and says when each is done; every task given to it comes back exactly once."""

    def __enter__(self) -> "Engine": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def capacity(self) -> int:
        """Tasks it can work on at once."""
        ...

    def submit(self, task: Task) -> None:
        """Take a task; at most ``capacity`` at once."""
        ...

    def collect(self) -> Sequence[Finished]:
        """Wait until at least one task is done."""
        ...


def worker_count(config: EngineConfig) -> int:
    """Workers of this machine: as many as asked for, else as its cores and memory allow, and one at least."""
    if config.workers is not None:
        return config.workers
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    return max(1, min(len(os.sched_getaffinity(0)), memory // (config.worker_memory_mb * 2**20)))


class LocalEngine:
    """Worker processes on this machine.

    Each worker is a pool of its own, so that when one dies it is known which task it was at: that one is given to a
    new worker, once.
    """

    def __init__(self, workers: int) -> None:
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["__main__", "lsvision.archive.tasks"])
        self._idle = [self._new_worker() for _ in range(workers)]
        self._busy: dict[Future[TaskResult], tuple[Task, ProcessPoolExecutor]] = {}
        self._deaths: dict[Task, int] = {}
        self._workers = workers

    def __enter__(self) -> "LocalEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pool in [*self._idle, *(pool for _, pool in self._busy.values())]:
            pool.shutdown(wait=kind is None, cancel_futures=True)

    @property
    def capacity(self) -> int:
        """One task a worker."""
        return self._workers

    def submit(self, task: Task) -> None:
        """Give a task to an idle worker."""
        pool = self._idle.pop()
        try:
            future = pool.submit(run_task, task)
        except BrokenProcessPool:  # killed while it had nothing to do
            pool.shutdown(wait=False)
            pool = self._new_worker()
            future = pool.submit(run_task, task)
        self._busy[future] = task, pool

    def collect(self) -> list[Finished]:
        """Wait for a worker; the task of one that died is tried once more."""
        while True:
            ready, _ = wait(self._busy, return_when=FIRST_COMPLETED)
            finished = [item for future in ready if (item := self._take(future)) is not None]
            if finished:
                return finished

    def _take(self, future: Future[TaskResult]) -> Finished | None:
        task, pool = self._busy.pop(future)
        try:
            result = future.result()
        except BrokenProcessPool:
            pool.shutdown(wait=False)
            self._idle.append(self._new_worker())
            return self._after_death(task)
        self._idle.append(pool)
        self._deaths.pop(task, None)
        return task, result

    def _after_death(self, task: Task) -> Finished | None:
        self._deaths[task] = self._deaths.get(task, 0) + 1
        if self._deaths[task] >= MOST_DEATHS:
            return task, TaskResult(error=f"{MOST_DEATHS} workers died at it, of memory or a signal")
        log.warning("a worker died at %s of %s; another takes it up", task.stage or "a step", task.scan)
        self.submit(task)
        return None

    def _new_worker(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=self._context, initializer=_start_worker)


def _start_worker() -> None:
    """Workers end with the run, however that ends, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
