"""The engine that works on this machine."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import forkserver
from types import TracebackType
from typing import Literal

from lsvision.archive.engines.protocol import MAX_FAILED_STARTS, MAX_WORKER_CRASHES, WORKERS_CRASHED, Finished
from lsvision.archive.tasks import Outcome, Task, run_in_worker
from lsvision.errors import LsvisionError
from lsvision.interruption import hidden_from_children, start_resource_tracker, uninterrupted

StartMethod = Literal["forkserver", "spawn"]

_PAUSE_S = 1e-3  # after a first worker that did not start; each further one, twice as long

log = logging.getLogger(__name__)


class LocalEngine:
    """Worker processes on this machine.

    Each worker is a pool of one process, so that it is known which task a crashed worker was at: the next free worker
    takes that up. A worker gets its first task when it has started, so that no task is blamed for a failed start.

    Args:
        start_method: of the processes, by ``multiprocessing``'s names; ``forkserver`` where the platform has it, else
            ``spawn``.
    """

    def __init__(self, workers: int, start_method: StartMethod | None = None) -> None:
        if start_method is None:
            start_method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        _forget_stdin()
        self._context = multiprocessing.get_context(start_method)
        if start_method == "forkserver":
            self._context.set_forkserver_preload(["__main__", "lsvision.archive.tasks"])
        self._workers = workers
        self._waiting: deque[Task] = deque()
        self._crashes: dict[Task, int] = {}
        self._idle: list[ProcessPoolExecutor] = []
        # The task that every other worker is at; None while it starts.
        self._busy: dict[Future, tuple[Task | None, ProcessPoolExecutor]] = {}
        self._failed_starts = 0
        start_resource_tracker()
        try:
            if start_method == "forkserver":
                self._wait_for_server()
            for _ in range(workers):
                self._start_worker()
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise

    def __enter__(self) -> "LocalEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted():
            for pool in [*self._idle, *(pool for _, pool in self._busy.values())]:
                # What is in progress is not waited for where the run is ended: a piece that is lost does no harm.
                for process in list((pool._processes or {}).values()) if kind is not None else ():
                    process.terminate()
                pool.shutdown(cancel_futures=True)

    @property
    def capacity(self) -> int:
        """One task per worker and as many waiting, so that no worker waits for this process."""
        return 2 * self._workers

    def submit(self, task: Task) -> None:
        """Take a task for the next free worker."""
        self._waiting.append(task)
        self._assign()

    def collect(self) -> list[Finished]:
        """Wait for a worker to finish a task.

        Raises:
            LsvisionError: workers do not start.
        """
        while True:
            ready, _ = wait(self._busy, return_when=FIRST_COMPLETED)
            finished = [item for future in ready if (item := self._take(future)) is not None]
            self._assign()
            if finished:
                return finished

    def _assign(self) -> None:
        while self._waiting and self._idle:
            pool = self._idle.pop()
            try:
                future = pool.submit(run_in_worker, self._waiting[0])
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
            return self._after_crash(task)
        self._idle.append(pool)
        if task is None:
            self._failed_starts = 0
            return None
        self._crashes.pop(task, None)
        return task, result

    def _after_crash(self, task: Task | None) -> Finished | None:
        if task is None:
            self._count_failed_start()
            return None
        self._crashes[task] = self._crashes.get(task, 0) + 1
        if self._crashes[task] >= MAX_WORKER_CRASHES:
            return task, Outcome(error=WORKERS_CRASHED)
        log.warning("a worker crashed at %s; another takes it up", task)
        self._waiting.appendleft(task)
        return None

    def _count_failed_start(self) -> None:
        """Count a worker that did not start, and wait a moment before the next."""
        self._failed_starts += 1
        if self._failed_starts > MAX_FAILED_STARTS:
            raise LsvisionError(f"workers do not start: {self._failed_starts} of them ended before their first task")
        # A server that was killed is found dead, and started anew, only when the system has ended it.
        time.sleep(_PAUSE_S * 2 ** (self._failed_starts - 1))

    def _replace(self, pool: ProcessPoolExecutor) -> None:
        pool.shutdown(wait=False)
        self._start_worker()

    def _start_worker(self) -> None:
        while True:
            pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_enter_worker)
            try:
                with uninterrupted(), hidden_from_children():
                    self._busy[pool.submit(os.getpid)] = None, pool
                return
            except (OSError, EOFError, BrokenProcessPool):  # the server that workers are forked from was killed
                pool.shutdown(wait=False)
                self._count_failed_start()

    def _wait_for_server(self) -> None:
        """Wait until the server that workers are forked from has imported what they need, which may be interrupted.

        A worker whose start is interrupted would print a trace for want of its queues: one without any is forked first.
        """
        with hidden_from_children():
            forkserver.ensure_running()  # all that it forks inherit that
        with suppress(OSError, EOFError):  # it was killed: noticed where workers start
            first = multiprocessing.get_context("forkserver").Process(target=os.getpid)
            first.start()
            first.join()


def _forget_stdin() -> None:
    """A program read from standard input claims a file, which workers would try to import."""
    main = sys.modules["__main__"]
    if getattr(main, "__file__", None) == "<stdin>":
        del main.__file__


def _enter_worker() -> None:
    """Workers end with the run, however that ends, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.unraisablehook = _end_where_ignored
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends a task, and then the worker, which tidies up
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_where_ignored(raised: "sys.UnraisableHookArgs") -> None:
    """Where ``SystemExit`` cannot be raised, as in ``__del__``, end at once."""
    if issubclass(raised.exc_type, SystemExit):
        os._exit(1)
    sys.__unraisablehook__(raised)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
