"""What an engine is: it runs tasks and returns their outcomes."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol

import psutil

from lsvision.archive.tasks import Outcome, Task
from lsvision.schema import Checked, PositiveInt, Text

# A task that crashed this many workers is given up.
MAX_WORKER_CRASHES = 3
WORKERS_CRASHED = f"{MAX_WORKER_CRASHES} workers crashed at it, of memory or a signal"
MAX_FAILED_STARTS = 10

Finished = tuple[Task, Outcome]


@dataclass(frozen=True)
class EngineConfig(Checked):
    """Where strips are computed.

    ``workers`` is as many as cores and memory allow where it is None. ``worker_memory_mb`` bounds what one takes:
    strips are sized by it. ``scheduler`` is the address of a Dask scheduler; a local cluster is started where it is
    None.
    """

    kind: Literal["local", "dask"] = "local"
    workers: PositiveInt | None = None
    worker_memory_mb: PositiveInt = 2048
    scheduler: Text | None = None


class Engine(Protocol):
    """Runs tasks and returns their outcomes; every submitted task comes back exactly once."""

    def __enter__(self) -> "Engine": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def capacity(self) -> int:
        """Number of tasks that may be submitted and not yet collected."""
        ...

    def submit(self, task: Task) -> None:
        """Take a task."""
        ...

    def collect(self) -> Sequence[Finished]:
        """Wait until at least one task is finished."""
        ...


def worker_count(config: EngineConfig) -> int:
    """Workers of this machine: as many as configured, else as its cores and free memory allow, and at least one."""
    if config.workers is not None:
        return config.workers
    return max(1, min(_core_count(), psutil.virtual_memory().available // (config.worker_memory_mb * 2**20)))


def _core_count() -> int:
    """Cores that this process may use."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # not on macOS
        return len(process.cpu_affinity())
    return psutil.cpu_count() or 1
