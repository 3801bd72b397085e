"""What an engine is: it runs tasks on workers and hands back their results."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol

from lsvision.archive.tasks import Task, TaskResult
from lsvision.schema import Checked, PositiveInt, Text

# A strip that ended this many workers is given up.
MOST_DEATHS = 3
MOST_FAILED_STARTS = 10

Finished = tuple[Task, TaskResult]


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
