"""Independent scans side by side: a thread a scan, each with one torch thread of its own."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import cv2
import torch


@contextmanager
def scan_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """A pool that works on ``threads`` scans at once.

    Strips are small: two of them side by side on one thread each finish sooner than one after the other on two, and do
    not wait for each other on a busy machine. torch and OpenCV release Python's lock while they compute.
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
