"""Experiments run in this process, through the same entry point as the command line."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lsvision import run

# Test processes share the processor already; "++" because a run without an experiment has no such option yet.
ONE_THREAD = ("++threads=1",)


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run ``python -m lsvision.run`` with overrides in a folder of its own; returns the exit code."""
    monkeypatch.chdir(tmp_path)

    def call(*overrides: str, folder: str = "run") -> int:
        monkeypatch.setattr(sys, "argv", ["lsvision", *overrides, *ONE_THREAD, f"hydra.run.dir={tmp_path / folder}"])
        try:
            run.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return call
