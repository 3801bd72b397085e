"""Platforms without Linux's own: nothing needs fcntl, and workers may be spawned."""

import subprocess
import sys

import pytest

from lsvision.archive import LocalEngine
from tests.archive.archives import assert_same_products, process

WITHOUT_FCNTL = """
import sys
sys.modules["fcntl"] = None
import lsvision.archive, lsvision.run
from pathlib import Path
with lsvision.archive.sole_run(Path(sys.argv[1])):
    print("held")
"""


def test_nothing_needs_fcntl(tmp_path):
    command = [sys.executable, "-W", "error", "-c", WITHOUT_FCNTL, str(tmp_path)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "held\n"


@pytest.mark.slow
def test_spawned_workers_make_the_same_products(archive, calibration, tmp_path):
    process(archive / "2024", calibration, tmp_path / "here")
    process(archive / "2024", calibration, tmp_path / "spawned", LocalEngine(2, "spawn"))
    assert_same_products(tmp_path / "here", tmp_path / "spawned")
