"""The engine that works on a Dask cluster."""

import logging
import os
from concurrent.futures import CancelledError
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import TracebackType

import dask
from dask.task_spec import Task as Spec
from distributed import Client, Future, KilledWorker, LocalCluster, Status

from lsvision.archive.engines.protocol import MOST_DEATHS, Finished
from lsvision.archive.tasks import Task, TaskResult, run_task
from lsvision.errors import ConfigError, LsvisionError

_LOOK_SECONDS = 1.0

# Tasks wait at the scheduler, not at a worker: the death of one says something of its own task alone. Dask does not
# look after local workers that are gone for long: it would end those that are just starting again. A local worker
# loads what tasks need before it takes one, so that no task answers for that time. It keeps freed memory for the next
# strip: Dask's own setting gives it back after every operation, which trebles the time.
_SETTINGS = {
    "distributed.worker.preload": ["lsvision.archive.tasks"],
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**30,
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.allowed-failures": MOST_DEATHS - 1,
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.deploy.lost-worker-timeout": "365 days",
    "distributed.comm.timeouts.connect": "10s",
}
# What matters of workers that come and go is in the results.
_LOGGERS = ("distributed", "distributed.client", "tornado.application")


class DaskEngine:
    """Workers of a scheduler, or of a local cluster where no address is given; they may come and go.

    Args:
        scheduler: address as ``tcp://host:8786``.
        workers: of a local cluster.
        worker_memory_mb: of a local cluster; a worker that takes far more is restarted.

    Raises:
        ConfigError: nothing answers at the address.
    """

    def __init__(self, scheduler: str | None, workers: int, worker_memory_mb: int) -> None:
        self._done: SimpleQueue[Future] = SimpleQueue()
        self._tasks: dict[Future, Task] = {}
        self._settings = dask.config.set(_SETTINGS)
        for name in _LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._cluster, self._workers = None, workers
        if scheduler is None:
            self._cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=worker_memory_mb * 2**20 * 2,
                dashboard_address=":0",
                silence_logs=50,
            )
        try:
            self._client = Client(scheduler or self._cluster, set_as_default=False, timeout="10s")
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(f"engine.scheduler: nothing answers at {scheduler}") from error

        self._threads = self._count_threads()

    def __enter__(self) -> "DaskEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()
        self._settings.__exit__(None, None, None)

    @property
    def dashboard(self) -> str:
        """Address of the progress view."""
        return str(self._client.dashboard_link)

    @property
    def capacity(self) -> int:
        """A task a thread and as many waiting, so that no worker waits for this process."""
        return 2 * max(1, self._threads)

    def submit(self, task: Task) -> None:
        """Hand a task to the scheduler."""
        key = f"{task.stage or 'step'}-{os.urandom(8).hex()}"
        # One that produces data waits at the scheduler however few there are; others only where there are many.
        spec = Spec(key, run_task, task, _data_producer=True)
        future = self._client.get({key: spec}, key, sync=False)
        self._tasks[future] = task
        future.add_done_callback(self._done.put)

    def collect(self) -> list[Finished]:
        """Wait for a task; workers that died are the scheduler's concern.

        Raises:
            LsvisionError: the scheduler is gone.
        """
        while True:
            if self._client.status != "running":
                raise _lost()
            self._threads = self._count_threads()
            if self._cluster is not None and self._threads < self._workers:
                self._cluster.sync(_replace_lost, self._cluster)
            with suppress(Empty):
                finished = self._take(self._done.get(timeout=_LOOK_SECONDS))
                if finished is not None:
                    return [finished]

    def _count_threads(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise _lost() from error

    def _take(self, future: Future) -> Finished | None:
        """A task and its result; None where that died with the worker that kept it, and the task runs again."""
        try:
            result = future.result(timeout=_LOOK_SECONDS)
        except TimeoutError:  # not waited for here: it may be for workers that only the next look starts
            future.add_done_callback(self._done.put)
            return None
        except KilledWorker:
            result = TaskResult(error=f"{MOST_DEATHS} workers died at it, of memory or a signal")
        except (CancelledError, OSError) as error:
            raise _lost() from error
        return self._tasks.pop(future), result


async def _replace_lost(cluster: LocalCluster) -> None:
    """Have workers started for those that died while they started, which are not replaced by themselves."""
    for name, nanny in list(cluster.workers.items()):
        if nanny.status in (Status.closed, Status.failed):
            del cluster.workers[name]
    cluster.scale(len(cluster.worker_spec))


def _lost() -> LsvisionError:
    return LsvisionError("the Dask scheduler is gone; what was done is kept: run the same again to go on")
