"""Shapes are checked while the tests run; every test starts from one seed and one thread."""

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

# Before torch is loaded: threads that wait for each other sleep, and leave the processor to xdist's other workers.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch

from tests.shapes import install_checks

LIBRARY = Path(__file__).parents[1]
# Not the options (config.py, study.points): the library itself reports a value of a wrong type there.
STAGES = [
    path for path in (LIBRARY / "lsvision" / "stages").rglob("*.py") if path.name not in ("config.py", "__init__.py")
]
install_checks(
    [
        "lsvision.geometry",
        "lsvision.estimation",
        "lsvision.image",
        *(f"lsvision.study.{name}" for name in ("map", "runs", "tables")),
        *(".".join(path.relative_to(LIBRARY).with_suffix("").parts) for path in STAGES),
    ]
)

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a background job: programs under test would ignore it too
    signal.signal(signal.SIGINT, signal.default_int_handler)

torch.set_num_threads(1)  # before the fixtures of wider scope; xdist's workers share the processor

# The same examples every time, and no clock: a slow machine is no failure.
hypothesis.settings.register_profile("seeded", derandomize=True, deadline=None)
hypothesis.settings.load_profile("seeded")

# Test processes share the processor already; "++" because a run without an experiment has no such option yet.
ONE_THREAD = ("++threads=1",)

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_collection_finish() -> None:
    """Libraries and tests stay: the garbage collector need not look through them again and again, nor so often."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.default_generator.manual_seed(0)  # of the processor: torch.manual_seed takes a millisecond for the others
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _signals() -> Iterator[None]:
    """A program ignores signals at its end, and so would all that a test process starts after it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real photographs and scans by another renderer, where the folder is present."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"{SHARED_DATA} is not here: the checks on scans from elsewhere did not run")
    return SHARED_DATA


@pytest.fixture
def rig():
    """The 3DPIXA-class rig at a quarter of its pixels."""
    from lsvision.types import Rig

    return Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375)


@pytest.fixture
def quick_reports(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are made whole, but their pictures are empty files: drawing takes most of a small scan's time.

    Tests marked ``drawn`` draw them, and figures in three dimensions from two sides.
    """
    from lsvision.report import embedding

    def blank(figure: object, path: Path) -> embedding.Embedded:
        for kind in ("png", "svg"):
            path.with_name(f"{path.name}.{kind}").touch()
        return embedding.Embedded(("data:image/png;base64,",), vector=False)

    if request.node.get_closest_marker("drawn"):
        monkeypatch.setattr(embedding, "_VIEWS", 2)
    else:
        monkeypatch.setattr("lsvision.report.pages.embed", blank)


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_reports: None) -> Callable[..., int]:
    """Run ``python -m lsvision.run`` in this process with overrides, in a folder of its own; returns the exit code."""
    from hydra._internal.hydra import Hydra

    from lsvision import run

    # Hydra composes everything twice, first to look for its mode, which no configuration of ours sets.
    monkeypatch.setattr(Hydra, "get_mode", lambda *_, **__: None)
    monkeypatch.chdir(tmp_path)

    def call(*overrides: str, folder: str = "run") -> int:
        monkeypatch.setattr(sys, "argv", ["lsvision", *overrides, *ONE_THREAD, f"hydra.run.dir={tmp_path / folder}"])
        try:
            run.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return call
