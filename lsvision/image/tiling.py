"""Work cut into pieces that fit the processor's cache, on as many threads as torch may use."""

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

# Windows of an image under tiles of this size, skewed by 3° and stretched by a tenth, still fit 257 x 513 pixels.
TILE_ROWS, TILE_COLUMNS = 192, 480

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT_BYTES = 256 * 2**20


def tiles(rows: int, columns: int) -> list[tuple[slice, slice]]:
    """Row and column ranges of the tiles of a plane."""
    return [
        (slice(row, min(row + TILE_ROWS, rows)), slice(column, min(column + TILE_COLUMNS, columns)))
        for row in range(0, rows, TILE_ROWS)
        for column in range(0, columns, TILE_COLUMNS)
    ]


def in_parallel(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of ``work`` on every item, in order: one thread an item, ``torch.get_num_threads()`` at a time.

    On pieces this small, threads that share every single operation would spend their time waiting for each other.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return [work(item) for item in items]
    return list(_pool(threads, os.getpid()).map(work, items))


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
