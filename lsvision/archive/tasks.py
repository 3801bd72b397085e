"""Tasks: pieces of work for the scans of an archive, and what came of them."""

import logging
import time
from dataclasses import dataclass
from functools import cache

import cv2
import torch

from lsvision.archive.ledger import Stage
from lsvision.archive.work import StripResult, Work
from lsvision.errors import LsvisionError
from lsvision.image.tiling import keep_freed_memory

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Strip:
    """Which strip of a stage a task makes, and the hash of everything that it depends on."""

    stage: Stage
    number: int
    key: str


@dataclass(frozen=True)
class Task:
    """A piece of work for the scan of a key; ``strip`` is None where it makes none."""

    scan: str
    work: Work
    strip: Strip | None = None

    def __str__(self) -> str:
        what = f"{self.strip.stage} strip {self.strip.number}" if self.strip else type(self.work).__name__
        return f"{self.scan}: {what}"


@dataclass(frozen=True)
class Outcome:
    """What came of a task: its result, or the error that kept it from one, and the seconds it took."""

    result: object = None
    error: str | None = None
    seconds: float = 0.0


def run_task(task: Task) -> Outcome:
    """Do a piece of work; whatever is wrong with its data is its outcome, never an exception."""
    begin = time.perf_counter()
    try:
        result = task.work.run()
    except LsvisionError as error:
        return Outcome(error=str(error))
    except OSError as error:
        return Outcome(error=f"{error.filename or task}: {error.strerror}")
    except Exception as error:  # one scan's fault, of whatever kind, must not end the others
        log.exception("%s", task)
        return Outcome(error=f"{type(error).__name__}: {error}")
    return Outcome(result, seconds=time.perf_counter() - begin)


def product_rows(task: Task, outcome: Outcome) -> int:
    """Rows of a product that a task made."""
    if task.strip is None or task.strip.stage != "product" or not isinstance(outcome.result, StripResult):
        return 0
    return outcome.result.lines


def run_in_worker(task: Task) -> Outcome:
    """``run_task`` on one thread, in a process that does nothing else."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _keep_freed_memory()
    return run_task(task)


_keep_freed_memory = cache(keep_freed_memory)  # once per process
