"""Independent scans side by side, one thread per scan."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2
import torch

Result = TypeVar("Result")


@contextmanager
def scan_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """A pool that works on ``threads`` scans at once, while torch and OpenCV use one thread each.

    Strips are small: two strips side by side, on one thread each, finish sooner than one after the other on two
    threads, and do not wait for each other on a busy machine. torch and OpenCV release Python's lock while they
    compute.
    """
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            yield pool
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def map_names(pool: ThreadPoolExecutor, function: Callable[[str], Result], names: Iterable[str]) -> dict[str, Result]:
    """Results of a function of a scan's name, by name, computed side by side."""
    names = list(names)
    return dict(zip(names, pool.map(function, names), strict=True))
