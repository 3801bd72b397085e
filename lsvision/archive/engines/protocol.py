"""What an engine is: it runs tasks and returns their outcomes."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol

import psutil

from lsvision.archive.tasks import Outcome, Task
from lsvision.schema import Checked, PositiveInt, Text, shown

# A task that crashed this many workers is given up.
MAX_WORKER_CRASHES = 3
WORKERS_CRASHED = f"{MAX_WORKER_CRASHES} workers crashed at it, of memory or a signal"
MAX_FAILED_STARTS = 10

_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?[^\s/]+:\d{1,5}")

Finished = tuple[Task, Outcome]


@dataclass(frozen=True)
class TlsFiles:
    """Certificate of the authority that all sides trust, and certificate and key of this side, as PEM files."""

    authority: str
    certificate: str
    key: str


@dataclass(frozen=True)
class EngineConfig(Checked):
    """Where strips are computed.

    ``workers`` is as many as cores and memory allow where it is None. ``worker_memory_mb`` bounds what one takes:
    strips are sized by it. ``scheduler`` is the address of a Dask scheduler; a local cluster is started where it is
    None. ``tls_authority``, ``tls_certificate`` and ``tls_key``, PEM files, encrypt what passes between this process,
    scheduler and workers of Dask, and keep everybody out who has no certificate of the authority; all three or none.
    """

    kind: Literal["local", "dask"] = "local"
    workers: PositiveInt | None = None
    worker_memory_mb: PositiveInt = 2048
    scheduler: Text | None = None
    tls_authority: Text | None = None
    tls_certificate: Text | None = None
    tls_key: Text | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scheduler is not None and not _ADDRESS.fullmatch(self.scheduler):
            raise self.fault("scheduler", f"expected an address as tcp://host:8786, got {shown(self.scheduler)}")
        files = {name: getattr(self, name) for name in ("tls_authority", "tls_certificate", "tls_key")}
        missing = [name for name, file in files.items() if file is None]
        if 0 < len(missing) < len(files):
            raise self.fault(missing[0], "missing; certificates are three files")
        if self.scheduler is not None and self.scheduler.startswith("tls://") == bool(missing):
            problem = "a scheduler at tls:// asks for certificates, and they for such a scheduler"
            raise self.fault("scheduler", f"{problem}: engine.tls_authority")

    @property
    def tls(self) -> TlsFiles | None:
        """The certificates, where they are given."""
        if self.tls_authority is None or self.tls_certificate is None or self.tls_key is None:
            return None
        return TlsFiles(self.tls_authority, self.tls_certificate, self.tls_key)


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
