"""One run at a time on an output."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lsvision.errors import ConfigError

LOCK_FILE = ".lock"


@contextmanager
def sole_run(output: Path) -> Iterator[None]:
    """Hold an output while the block runs; the lock goes with the process, however that ends.

    Raises:
        ConfigError: another run holds it.
    """
    output.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(output / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"output: another run is working on {output}; wait for it or choose another") from None
        yield
    finally:
        os.close(descriptor)
