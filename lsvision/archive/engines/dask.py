"""The engine that works on a Dask cluster."""

import logging
import os
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType

import dask
from dask.task_spec import Task as Spec
from distributed import Client, Future, KilledWorker, LocalCluster, Status
from distributed.security import Security

from lsvision.archive.engines.protocol import MAX_WORKER_CRASHES, WORKERS_CRASHED, Finished, TlsFiles
from lsvision.archive.tasks import Outcome, Task, run_in_worker
from lsvision.errors import ConfigError, LsvisionError
from lsvision.interruption import hidden_from_children, start_resource_tracker, uninterrupted

_POLL_SECONDS = 1.0

# Tasks wait at the scheduler, not at a worker: a crash then says something about the worker's own task alone. Dask does
# not watch for local workers that are gone for long: it would end those that are just starting again. A local worker
# imports what tasks need before it takes one, so that no task is blamed for that time. It keeps freed memory for the
# next strip: Dask's own setting gives it back after every operation, which trebles the time.
_SETTINGS = {
    "distributed.worker.preload": ["lsvision.archive.tasks"],
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**30,
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.allowed-failures": MAX_WORKER_CRASHES - 1,
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.deploy.lost-worker-timeout": "365 days",
    "distributed.comm.timeouts.connect": "10s",
}
# Their messages about workers that come and go repeat what the outcomes say.
_LOGGERS = ("distributed", "distributed.client", "tornado.application")


class DaskEngine:
    """Workers of a scheduler, or of a local cluster where no address is given; they may come and go.

    Args:
        scheduler: address as ``tcp://host:8786``.
        workers: of a local cluster.
        worker_memory_mb: of a local cluster; a worker that takes far more is restarted.
        tls: certificates, where only those who have one may take part.

    Raises:
        ConfigError: nothing answers at the address, or a certificate cannot be read.
    """

    def __init__(self, scheduler: str | None, workers: int, worker_memory_mb: int, tls: TlsFiles | None = None) -> None:
        self._finished: SimpleQueue[Future] = SimpleQueue()
        self._tasks: dict[Future, Task] = {}
        self._settings = dask.config.set(_SETTINGS)
        for name in _LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._workers = workers
        self._cluster: LocalCluster | None = None
        security = None if tls is None else _security(tls)
        try:
            with uninterrupted():
                if scheduler is None:
                    self._cluster = _local_cluster(workers, worker_memory_mb, security)
                self._client = _client(scheduler or self._cluster, security)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        self._threads = self._count_threads()

    def __enter__(self) -> "DaskEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted():
            if hasattr(self, "_client"):
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
        """One task per thread and as many waiting, so that no worker waits for this process."""
        return 2 * max(1, self._threads)

    def submit(self, task: Task) -> None:
        """Submit a task to the scheduler."""
        key = f"{task.strip.stage if task.strip else 'step'}-{os.urandom(8).hex()}"
        # A data producer waits at the scheduler however few tasks there are; others do so only where there are many.
        spec = Spec(key, run_in_worker, task, _data_producer=True)
        future = self._client.get({key: spec}, key, sync=False)
        self._tasks[future] = task
        future.add_done_callback(self._finished.put)

    def collect(self) -> list[Finished]:
        """Wait for a task; crashed workers are the scheduler's concern.

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
                finished = self._take(self._finished.get(timeout=_POLL_SECONDS))
                if finished is not None:
                    return [finished]

    def _count_threads(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise _lost() from error

    def _take(self, future: Future) -> Finished | None:
        """A task and its outcome; None where that was lost with the worker that kept it, and the task runs again."""
        try:
            result = future.result(timeout=_POLL_SECONDS)
        except TimeoutError:  # not waited for here: the workers it needs may only be started by the next poll
            future.add_done_callback(self._finished.put)
            return None
        except KilledWorker:
            result = Outcome(error=WORKERS_CRASHED)
        except (CancelledError, OSError) as error:
            raise _lost() from error
        return self._tasks.pop(future), result


def _local_cluster(workers: int, worker_memory_mb: int, security: Security | None) -> LocalCluster:
    start_resource_tracker()
    with hidden_from_children():
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=worker_memory_mb * 2**20 * 2,
            # Whoever reaches the scheduler or a worker can run any program: nobody from another machine can.
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs=50,
            security=security,
            protocol=None if security is None else "tls://",
        )


def _client(scheduler: str | LocalCluster, security: Security | None) -> Client:
    try:
        return Client(scheduler, security=security, set_as_default=False, timeout="10s")
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(f"engine.scheduler: nothing answers at {scheduler}") from error


def _security(tls: TlsFiles) -> Security:
    """Certificates as Dask takes them.

    Raises:
        ConfigError: a file cannot be read; names it.
    """
    files = asdict(tls)
    for name, file in files.items():
        try:
            Path(file).read_bytes()
        except OSError as error:
            raise ConfigError(f"engine.tls_{name}: {file}: {error.strerror}") from error
    sides = {f"tls_{side}_{kind}": files[name] for side in ("client", "scheduler", "worker")
             for kind, name in (("cert", "certificate"), ("key", "key"))}  # fmt: skip
    return Security(tls_ca_file=tls.authority, require_encryption=True, **sides)


async def _replace_lost(cluster: LocalCluster) -> None:
    """Replace workers that crashed while they started: Dask does not do so by itself."""
    for name, nanny in list(cluster.workers.items()):
        if nanny.status in (Status.closed, Status.failed):
            del cluster.workers[name]
    cluster.scale(len(cluster.worker_spec))


def _lost() -> LsvisionError:
    return LsvisionError("the Dask scheduler is gone; finished strips are kept: run the same command again to go on")
