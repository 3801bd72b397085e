"""Work cut into pieces that fit the processor's cache, on as many threads as torch may use."""

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

TILE = (512, 480)  # rows and columns; tall, because a tile sees more scan lines than it has rows

_ROWS_AT_ONCE = 32  # of maps that are some thousand columns wide

# Positions are rounded to this part of a pixel. Float32 holds such fractions exactly up to 8192 pixels, so that a
# sample does not depend on the tile from which its position is counted.
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


@dataclass(frozen=True)
class HaloRange:
    """The range ``start..stop-1`` of an axis, and ``outer_start..outer_stop-1``, which adds a halo at both ends."""

    start: int
    stop: int
    outer_start: int
    outer_stop: int

    @classmethod
    def at(cls, start: int, size: int, halo: int, length: int) -> "HaloRange":
        """The range of ``size`` from ``start`` on, cut to an axis of some length."""
        stop = min(start + size, length)
        return cls(start, stop, max(start - halo, 0), min(stop + halo, length))

    @property
    def outer(self) -> slice:
        """The range with its halo."""
        return slice(self.outer_start, self.outer_stop)

    @property
    def inner(self) -> slice:
        """The range without its halo, counted from the start of the halo."""
        return slice(self.start - self.outer_start, self.stop - self.outer_start)


def halo_ranges(length: int, size: int, halo: int) -> list[HaloRange]:
    """Ranges of at most ``size`` that cover an axis once, each with its halo."""
    return [HaloRange.at(start, size, halo, length) for start in range(0, length, size)]


def in_parallel(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of ``work`` on every item, in order, by ``torch.get_num_threads()`` threads with one item each.

    On pieces this small, threads that share each single operation would mostly wait for each other.

    Raises:
        Exception: that of the first item that failed, after all threads have stopped working.
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


def by_rows(work: Callable[..., torch.Tensor], *maps: torch.Tensor) -> torch.Tensor:
    """Result of a function of single rows, computed a few rows at a time.

    A dozen passes over rows that stay in the processor's cache take half the time of passes over whole maps.

    Args:
        work: of the same rows of each map; returns values of the shape and type of the first one's.
        maps: with as many rows each.
    """
    result = torch.empty_like(maps[0])

    def write(rows: HaloRange) -> None:
        result[rows.start : rows.stop] = work(*(values[rows.start : rows.stop] for values in maps))

    in_parallel(write, halo_ranges(len(result), _ROWS_AT_ONCE, 0))
    return result


@functools.cache
def _pool(threads: int, _process: int) -> ThreadPoolExecutor:
    """Threads that are kept, because starting them takes as long as a dozen tiles; a forked process needs new ones."""
    pool = ThreadPoolExecutor(threads)
    ready = threading.Barrier(threads + 1)

    def use_one_thread() -> None:
        torch.set_num_threads(1)
        torch.get_num_threads()  # from here on the thread keeps its setting, whatever others set
        ready.wait()

    started = [pool.submit(use_one_thread) for _ in range(threads)]
    ready.wait()
    for thread in started:
        thread.result()
    torch.set_num_threads(threads)  # the setting of one thread also holds for those started later
    return pool


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One thread for each of torch's operations within the block: for bits, or where other threads work already."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> bool:
    """Keep the memory of finished tiles for the next ones; returns whether the C library can, which glibc alone does.

    By default glibc returns it to the system after every tile and gets it back page by page, which takes as long as the
    work itself.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl has none
        return False
    mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES // 8)
    mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
    mallopt(_M_ARENA_MAX, 1)
    return True
