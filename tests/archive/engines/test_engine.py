"""Workers that crash, and engines that bring every task back once."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from lsvision.archive import EngineConfig, LocalEngine, worker_count
from lsvision.archive.tasks import Task, run_task
from lsvision.errors import FileFormatError


@dataclass(frozen=True)
class Deadly:
    """Kills its worker the first ``times`` times that it runs, which it counts in a file."""

    count: str
    times: int

    def run(self) -> str:
        with Path(self.count).open("a") as file:
            file.write("x")
        if Path(self.count).stat().st_size <= self.times:
            os.kill(os.getpid(), signal.SIGKILL)
        return "survived"


@dataclass(frozen=True)
class Faulty:
    """Raises."""

    error: Exception

    def run(self) -> None:
        raise self.error


@dataclass(frozen=True)
class Number:
    """Returns its number."""

    number: int

    def run(self) -> int:
        return self.number


@dataclass(frozen=True)
class Asleep:
    """Takes a while."""

    seconds: float

    def run(self) -> None:
        time.sleep(self.seconds)


def collected(engine, tasks) -> dict:
    waiting, found, out = list(tasks), [], 0
    while waiting or out:
        while waiting and out < engine.capacity:
            engine.submit(waiting.pop())
            out += 1
        finished = engine.collect()
        out -= len(finished)
        found += finished
    assert len(dict(found)) == len(found)
    return dict(found)


def test_every_task_comes_back_once_though_workers_crash(tmp_path):
    tasks = [Task("a", Number(number)) for number in range(12)]
    once, always = Task("b", Deadly(str(tmp_path / "once"), 1)), Task("c", Deadly(str(tmp_path / "always"), 9))
    with LocalEngine(2) as engine:
        found = collected(engine, [*tasks, once, always])
    assert [found[task].result for task in tasks] == list(range(12))
    assert found[once].result == "survived"
    assert found[always].error == "3 workers crashed at it, of memory or a signal"
    assert (tmp_path / "always").stat().st_size == 3


@pytest.mark.slow
def test_dask_brings_every_task_back_once_though_workers_crash(tmp_path):
    pytest.importorskip("distributed")
    from lsvision.archive.engines.dask import DaskEngine

    tasks = [Task("a", Number(number)) for number in range(12)]
    once, always = Task("b", Deadly(str(tmp_path / "once"), 1)), Task("c", Deadly(str(tmp_path / "always"), 9))
    with DaskEngine(None, 2, 3072) as engine:
        found = collected(engine, [*tasks, once, always])
    assert [found[task].result for task in tasks] == list(range(12))
    assert found[once].result == "survived"
    assert found[always].error == "3 workers crashed at it, of memory or a signal"


@pytest.mark.slow
def test_dask_lets_no_task_wait_where_another_could_end_the_worker():
    pytest.importorskip("distributed")
    from lsvision.archive.engines.dask import DaskEngine

    with DaskEngine(None, 1, 3072) as engine:
        for number in range(2):
            engine.submit(Task(f"{number}", Asleep(1.0)))
        most = 0
        while engine._finished.empty():
            most = max([most, *map(len, engine._client.processing().values())])
        assert most == 1
        assert len([*engine.collect(), *engine.collect()]) == 2


def test_a_local_cluster_listens_to_this_machine_alone():
    pytest.importorskip("distributed")
    from lsvision.archive.engines.dask import DaskEngine

    own = psutil.Process()
    before = {found.laddr for found in own.net_connections("tcp")}
    with DaskEngine(None, 1, 3072) as engine:
        assert engine._client.wait_for_workers(1) is None
        found = [found for process in (own, *own.children(recursive=True)) for found in process.net_connections("tcp")]
        listening = {item.laddr for item in found if item.status == psutil.CONN_LISTEN} - before
        assert engine.dashboard.startswith("http://127.0.0.1:")
    assert len(listening) >= 3  # the scheduler, its dashboard, a worker
    assert {address.ip for address in listening} == {"127.0.0.1"}


@pytest.mark.slow
def test_dask_runs_a_task_again_whose_result_died_with_all_workers():
    pytest.importorskip("distributed")
    from lsvision.archive.engines.dask import DaskEngine

    task = Task("a", Number(5))
    with DaskEngine(None, 1, 3072) as engine:
        engine.submit(task)
        future = engine._finished.get(timeout=60)
        engine._client.sync(engine._cluster.workers[0].close)  # its nanny with it: nobody starts another by himself
        while engine._client.nthreads():
            time.sleep(0.01)
        assert engine._take(future) is None
        assert [(found, outcome.result) for found, outcome in engine.collect()] == [(task, 5)]


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (FileFormatError("left.tif", "cut short"), "left.tif: cut short"),
        (OSError(28, "No space left on device", "a.zarr"), "a.zarr: No space left on device"),
        (MemoryError("of 9 GB"), "MemoryError: of 9 GB"),
    ],
)
def test_what_is_wrong_with_the_data_is_a_result(error, told):
    assert run_task(Task("a", Faulty(error))).error == told


def test_workers_as_asked_for_or_as_memory_allows():
    assert worker_count(EngineConfig(workers=7)) == 7
    assert worker_count(EngineConfig(worker_memory_mb=1 << 30)) == 1
    assert 1 <= worker_count(EngineConfig()) <= (os.cpu_count() or 1)
