"""One run at a time on an output."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lsvision.errors import ConfigError

with warnings.catch_warnings():
    # Where the system cannot lock a file, filelock warns and takes the file's presence for the lock.
    warnings.filterwarnings("ignore", message="only soft file lock is available")
    from filelock import FileLock, Timeout

LOCK_FILE = ".lock"


def is_worked_on(output: Path) -> bool:
    """Whether a run holds an output; one whose lock cannot be asked for counts as held."""
    if not (output / LOCK_FILE).is_file():
        return False
    lock = FileLock(output / LOCK_FILE)
    try:
        lock.acquire(blocking=False)
    except (Timeout, OSError):
        return True
    lock.release()
    return False


@contextmanager
def sole_run(output: Path, lock_file: Path | None = None) -> Iterator[None]:
    """Hold an output, or the part of it that a lock file stands for, while the block runs.

    The lock goes with the process, however that ends.

    Args:
        lock_file: ``.lock`` in the output where it is None.

    Raises:
        ConfigError: another run holds it.
    """
    path = lock_file or output / LOCK_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ConfigError(f"output: another run is working on {output}; wait for it or choose another") from None
    try:
        yield
    finally:
        lock.release()
