"""Work cut into pieces that fit the processor's cache, on as many threads as torch may use."""

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

TILE = (512, 480)  # rows and columns; tall, for what a tile sees lies in more lines than it has rows

# Positions are rounded to this part of a pixel: float32 holds such a fraction of up to 8192 pixels exactly, so that
# what is sampled there does not depend on the tile it is counted from.
PIXEL_PARTS = 2048

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of glibc's malloc.h
_KEPT_BYTES = 256 * 2**20


def tiles(rows: int, columns: int, size: tuple[int, int] = TILE) -> list[tuple[slice, slice]]:
    """Row and column ranges of the tiles of a plane, each of at most ``size`` rows and columns."""
    return [
        (slice(row, min(row + size[0], rows)), slice(column, min(column + size[1], columns)))
        for row in range(0, rows, size[0])
        for column in range(0, columns, size[1])
    ]


def in_parallel(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of ``work`` on every item, in order: one thread an item, ``torch.get_num_threads()`` at a time.

    On pieces this small, threads that share every single operation would spend their time waiting for each other.

    Raises:
        Exception: what the first item that failed raised, when none is worked on any more.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return [work(item) for item in items]
    pool = _pool(threads, os.getpid())
    futures = [pool.submit(work, item) for item in items]
    try:
        return [future.result() for future in futures]
    finally:
        wait([future for future in futures if not future.cancel()])


@functools.cache
def _pool(threads: int, _process: int) -> ThreadPoolExecutor:
    """Threads that stay, for starting them takes as long as a dozen tiles; a forked process needs its own."""
    pool = ThreadPoolExecutor(threads)
    ready = threading.Barrier(threads + 1)

    def use_one_thread() -> None:
        torch.set_num_threads(1)
        torch.get_num_threads()  # from here on the thread keeps its number, whatever others set
        ready.wait()

    started = [pool.submit(use_one_thread) for _ in range(threads)]
    ready.wait()
    for thread in started:
        thread.result()
    torch.set_num_threads(threads)  # what the threads have set also holds for those started later
    return pool


def keep_freed_memory() -> None:
    """Let the process keep the memory of finished tiles for the next ones, where the C library is glibc.

    By default it goes back to the system after every tile and comes again page by page, which takes as long as the
    work itself.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES // 8)
            mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
            mallopt(_M_ARENA_MAX, 1)
