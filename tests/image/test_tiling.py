"""Tiles cover a plane once; work in threads keeps its order and the thread setting."""

import threading

import pytest
import torch

from lsvision.image.tiling import in_parallel, keep_freed_memory, tiles


@pytest.mark.parametrize("shape", [(1, 1), (192, 480), (193, 481), (500, 1300)])
def test_tiles_cover_every_cell_once(shape: tuple[int, int]) -> None:
    covered = torch.zeros(shape, dtype=torch.int32)
    for tile in tiles(*shape):
        covered[tile] += 1
    assert bool((covered == 1).all())


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_order(threads: int) -> None:
    torch.set_num_threads(threads)
    inside = in_parallel(lambda item: (item, torch.get_num_threads()), range(20))
    assert inside == [(item, 1) for item in range(20)]
    assert torch.get_num_threads() == threads


def test_an_error_in_a_thread_reaches_the_caller() -> None:
    torch.set_num_threads(2)
    with pytest.raises(ZeroDivisionError):
        in_parallel(lambda item: 1 // item, [1, 0, 2])
    assert torch.get_num_threads() == 2


def test_no_thread_is_at_work_any_more_when_an_error_reaches_the_caller() -> None:
    torch.set_num_threads(2)
    begun, failed, finished = threading.Event(), threading.Event(), []

    def work(item: int) -> None:
        if item == 0:
            begun.wait()
            failed.set()
            raise ZeroDivisionError
        begun.set()
        failed.wait()
        torch.ones(2000, 2000).cumsum(0).cumsum(1)
        finished.append(item)

    with pytest.raises(ZeroDivisionError):
        in_parallel(work, [0, 1])
    assert finished == [1]


def test_keeping_memory_is_harmless() -> None:
    keep_freed_memory()
    assert float(torch.ones(2_000_000).sum()) == 2e6
