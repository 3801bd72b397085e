"""Runs that are ended or whose workers cannot start: soon over, and one line."""

import multiprocessing.forkserver
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from lsvision.archive import LocalEngine
from lsvision.archive.engines import local
from lsvision.archive.tasks import Task
from lsvision.errors import LsvisionError
from tests.archive.engines.test_engine import Number, collected


@dataclass(frozen=True)
class Busy:
    """Notes that it began, and takes a minute."""

    began: str

    def run(self) -> None:
        Path(self.began).touch()
        time.sleep(60)


def at_work(engine: LocalEngine, began: Path) -> list[psutil.Process]:
    """Wait until a task has begun; the worker that is at it."""
    while not began.exists():
        for future in [future for future in engine._busy if future.done()]:
            engine._take(future)
        engine._assign()
        time.sleep(0.01)
    return [psutil.Process(pid) for _, pool in engine._busy.values() for pid in pool._processes]


def test_what_is_in_progress_is_not_waited_for(tmp_path):
    engine = LocalEngine(1)
    engine.submit(Task("a", Busy(str(tmp_path / "began"))))
    workers = at_work(engine, tmp_path / "began")
    assert workers
    engine.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not psutil.wait_procs(workers, timeout=10)[1]


def test_the_server_of_workers_is_killed(tmp_path):
    with LocalEngine(1) as engine:
        assert collected(engine, [Task("a", Number(1))])
        os.kill(multiprocessing.forkserver._forkserver._forkserver_pid, signal.SIGKILL)
        for pool in [*engine._idle]:
            for pid in pool._processes:
                os.kill(pid, signal.SIGKILL)
        found = collected(engine, [Task("a", Number(2))])
    assert [outcome.result for outcome in found.values()] == [2]


@pytest.mark.parametrize("error", [EOFError(), ConnectionResetError("gone"), BrokenPipeError()])
def test_workers_that_never_start_are_one_line(monkeypatch, error):
    def refuse(_):
        raise error

    monkeypatch.setattr(multiprocessing.forkserver, "connect_to_new_process", refuse)
    monkeypatch.setattr(local, "_PAUSE_S", 0.0)
    with pytest.raises(LsvisionError, match="workers do not start: 11 of them ended before their first task"):
        LocalEngine(1)
