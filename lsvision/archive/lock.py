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

# Whoever asks whether an output is worked on holds its lock for a moment; a run that starts in it is not refused.
_PATIENCE_S, _POLL_S = 1.0, 0.02
_TRIALS = 100  # of making a folder that another run may remove, empty as it is, before there is a lock in it


def is_worked_on(output: Path) -> bool:
    """Whether a run holds an output; one whose lock cannot be asked for counts as held."""
    if not (output / LOCK_FILE).is_file():
        return False
    with lock_if_free(output / LOCK_FILE) as free:
        return not free


@contextmanager
def lock_if_free(lock_file: Path) -> Iterator[bool]:
    """Hold a lock for the block if no run does; gives whether it is held. The block is to be short."""
    lock = FileLock(lock_file)
    try:
        lock.acquire(blocking=False)
    except (Timeout, OSError):
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


@contextmanager
def sole_run(output: Path, lock_file: Path | None = None) -> Iterator[None]:
    """Hold an output, or the part of it that a lock file stands for, while the block runs.

    The lock goes with the process, however that ends.

    Args:
        lock_file: ``.lock`` in the output where it is None.

    Raises:
        ConfigError: another run holds it.
    """
    lock = FileLock(lock_file or output / LOCK_FILE)
    try:
        _acquire(lock)
    except Timeout:
        raise ConfigError(f"output: another run is working on {output}; wait for it or choose another") from None
    try:
        yield
    finally:
        lock.release()


def _acquire(lock: FileLock) -> None:
    """Make a lock's folder and take the lock; the run before, ending, may remove the folder between the two."""
    folder = Path(lock.lock_file).parent
    for trial in range(_TRIALS):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=_PATIENCE_S, poll_interval=_POLL_S)
        except (FileNotFoundError, FileExistsError):  # the latter where it was there, and is gone at a second look
            if trial == _TRIALS - 1:
                raise
        else:
            return
