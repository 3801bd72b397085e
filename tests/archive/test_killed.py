"""kill -9 of a worker, of the whole run and of the Dask scheduler, at random moments: nothing lost, nothing twice."""

import contextlib
import itertools
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lsvision.archive import LEDGER_FILE, Ledger
from lsvision.errors import LsvisionError
from tests.archive.archives import assert_same_products, make_calibration, make_scan, shaken

pytestmark = pytest.mark.slow
psutil = pytest.importorskip("psutil")

MOMENTS = 10
STRIPS = 6 * 13 + 12 + 12 * 14 + 12  # matching, line motion, correction, health
MOST_SECONDS = 300


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("archive")
    for number in range(12):
        make_scan(root / f"s{number}", 400, number, stereo=number % 2 == 0, line_motion=shaken(400))
    make_calibration(root / "calibration.json")
    return root


def start(archive: Path, output: Path, *options: str) -> subprocess.Popen:
    return subprocess.Popen(
        [
            sys.executable, "-m", "lsvision.run", "+experiment=reprocess", f"archive={archive}",
            f"calibration={archive / 'calibration.json'}", f"output={output}", "engine.workers=2",
            "disparity.block_lines=32", "disparity.strip_lines=32", "disparity.halo_lines=8",
            "correction.strip_rows=32",
            f"hydra.run.dir={output.with_name(output.name + '-run')}", *options,
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def finish(process: subprocess.Popen) -> str:
    output, _ = process.communicate(timeout=MOST_SECONDS)
    assert process.returncode == 0, output
    return output


@pytest.fixture(scope="module")
def undisturbed(archive, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("undisturbed") / "o"
    finish(start(archive, output))
    return output


def done_strips(output: Path) -> dict[tuple[str, str, int], tuple[float, int]]:
    """What the ledger says is done, with how long it took: a strip that ran again would have taken another time."""
    if not (output / LEDGER_FILE).is_file():
        return {}
    try:
        with Ledger(output / LEDGER_FILE) as ledger:
            strips = ledger.strips()
    except LsvisionError:  # being made
        return {}
    return {(s.scan, s.stage, s.number): (s.seconds, s.runs) for s in strips if s.status == "done"}


def wait_for(process: subprocess.Popen, output: Path, strips: int) -> None:
    """Until so many strips are done, and a random moment more."""
    wait_until(process, lambda: len(done_strips(output)) >= strips)
    time.sleep(random.random() * 0.05)


def wait_until(process: subprocess.Popen, reached: Callable[[], bool]) -> None:
    """Or until the run is over; one that stands still is ended and fails the test."""
    last = time.monotonic() + MOST_SECONDS
    while process.poll() is None and not reached():
        time.sleep(0.01)
        if time.monotonic() > last:
            os.killpg(process.pid, signal.SIGKILL)
            pytest.fail(f"stands still:\n{process.communicate()[0]}")


def moments() -> list[int]:
    return sorted(random.Random(0).sample(range(STRIPS - 40), MOMENTS))


def assert_whole(output: Path, undisturbed: Path) -> None:
    assert_same_products(undisturbed, output)
    strips = done_strips(output)
    assert len(strips) == STRIPS
    assert all(runs == 1 for _, runs in strips.values())
    assert not list(output.rglob("*.partial"))


def test_the_whole_run(archive, undisturbed, tmp_path):
    done: dict = {}
    for turn, strips in enumerate(moments()):
        process = start(archive, tmp_path / "o")
        wait_for(process, tmp_path / "o", strips)
        # Of every other run only the process that leads it: its workers have to end by themselves.
        (os.kill if turn % 2 else os.killpg)(process.pid, signal.SIGKILL)
        process.communicate()
        now = done_strips(tmp_path / "o")
        assert done.items() <= now.items()
        done = now
    finish(start(archive, tmp_path / "o"))
    assert done.items() <= done_strips(tmp_path / "o").items()
    assert_whole(tmp_path / "o", undisturbed)


@pytest.mark.parametrize("engine", ["local", "dask"])
def test_a_worker(archive, undisturbed, tmp_path, engine):
    killed, most = 0, time.monotonic() + MOST_SECONDS
    for turn in itertools.count():
        output = tmp_path / f"o{turn}"
        killed += run_and_kill_workers(archive, output, engine)
        assert_whole(output, undisturbed)
        if killed >= MOMENTS - 2:  # else it was done before there was time to kill
            return
        assert time.monotonic() < most, f"{killed} workers killed in {turn + 1} runs"


def run_and_kill_workers(archive: Path, output: Path, engine: str) -> int:
    """Take a run to its end, a worker killed at each moment that is reached; how many were."""
    process = start(archive, output, f"engine={engine}")
    killed = 0
    for strips in moments():
        wait_for(process, output, strips)
        wait_until(process, lambda: kill_a_worker(process.pid))  # those killed before are being replaced
        killed += process.poll() is None
    output_text, _ = process.communicate(timeout=MOST_SECONDS)
    if process.returncode:  # a strip whose worker was hit three times is given up, and made by the next run
        assert "3 workers crashed at it" in output_text, output_text
        finish(start(archive, output, f"engine={engine}"))
    return killed


def kill_a_worker(run: int) -> bool:
    """Kill one of the processes below a run that have none below them; False where there is none."""
    with contextlib.suppress(psutil.NoSuchProcess):
        below = psutil.Process(run).children(recursive=True)
        workers = [
            child for child in below if not child.children() and "resource_tracker" not in " ".join(child.cmdline())
        ]
        if workers:
            random.choice(workers).kill()
            return True
    return False


@pytest.fixture
def cluster(tmp_path) -> Iterator:
    """Starts a scheduler and two workers of its own on a free port; all of it goes with the test."""
    started: list[subprocess.Popen] = []

    def call() -> tuple[str, subprocess.Popen]:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        address = f"tcp://127.0.0.1:{port}"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
        dask = [sys.executable, "-m", "dask"]
        own = [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        worker = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"]
        scheduler = subprocess.Popen(own, **quiet)
        workers = [subprocess.Popen(worker, **quiet) for _ in range(2)]
        started.extend([scheduler, *workers])
        return address, scheduler

    yield call
    for process in started:
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in psutil.Process(process.pid).children(recursive=True):
                child.kill()
        process.kill()
        process.wait()


def test_the_scheduler(archive, undisturbed, tmp_path, cluster):
    pytest.importorskip("distributed")
    done: dict = {}
    for strips in moments():
        address, scheduler = cluster()
        process = start(archive, tmp_path / "o", "engine=dask", f"engine.scheduler={address}")
        wait_for(process, tmp_path / "o", strips)
        scheduler.kill()
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 1, output
        assert re.search(r"error: (the Dask scheduler is gone|engine.scheduler: nothing answers)", output), output
        now = done_strips(tmp_path / "o")
        assert done.items() <= now.items()
        done = now
    address, _ = cluster()
    finish(start(archive, tmp_path / "o", "engine=dask", f"engine.scheduler={address}"))
    assert done.items() <= done_strips(tmp_path / "o").items()
    assert_whole(tmp_path / "o", undisturbed)


def test_two_runs_at_once(archive, undisturbed, tmp_path):
    first = start(archive, tmp_path / "o")
    wait_for(first, tmp_path / "o", 1)
    first.send_signal(signal.SIGSTOP)  # held at work while the second starts, however slow the machine
    second = start(archive, tmp_path / "o")
    output, _ = second.communicate(timeout=120)
    first.send_signal(signal.SIGCONT)
    assert second.returncode == 1, output
    assert "error: output: another run is working on" in output
    finish(first)
    assert_whole(tmp_path / "o", undisturbed)
