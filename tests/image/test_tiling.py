"""Tiles cover a plane once; work in threads keeps its order and the thread setting."""

import ctypes
import sys
import threading

import pytest
import torch

from lsvision.image.tiling import HaloRange, by_rows, halo_ranges, in_parallel, keep_freed_memory, tiles


@pytest.mark.parametrize("shape", [(1, 1), (192, 480), (193, 481), (500, 1300)])
def test_tiles_cover_every_cell_once(shape: tuple[int, int]) -> None:
    covered = torch.zeros(shape, dtype=torch.int32)
    for tile in tiles(*shape):
        covered[tile] += 1
    assert bool((covered == 1).all())


def test_ranges_with_halo_by_hand() -> None:
    expected = [HaloRange(0, 4, 0, 6), HaloRange(4, 8, 2, 10), HaloRange(8, 11, 6, 11)]
    assert halo_ranges(11, 4, 2) == expected
    axis = list(range(11))
    for part in expected:
        assert axis[part.outer][part.inner] == axis[part.start : part.stop]


@pytest.mark.parametrize("rows", [1, 32, 77])
def test_few_rows_at_once_give_what_all_give(rows: int) -> None:
    a, b = torch.randn(rows, 5), torch.randn(rows, 5)
    assert torch.equal(by_rows(lambda x, y: x.cumsum(1) * y, a, b), a.cumsum(1) * b)


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


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_other_systems_have_no_such_setting(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_library(name: None) -> None:
        raise TypeError(f"{name} names no library")

    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(ctypes, "CDLL", no_library)
    assert not keep_freed_memory()


def test_other_c_libraries_have_no_such_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory()
