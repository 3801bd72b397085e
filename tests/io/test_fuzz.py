"""Damaged files of every kind that a command reads: read, or one line, in little memory and time."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource")


@pytest.mark.parametrize("number", [30, pytest.param(2600, marks=pytest.mark.slow)])
def test_damage_is_one_line_within_limits(tmp_path, number):
    done = subprocess.run(
        [sys.executable, "-m", "tests.io.fuzz", str(tmp_path), str(number)],
        capture_output=True, text=True, check=False, timeout=300, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["faults"] == []
    assert result["inputs"] >= number
    assert result["peak_mb"] < 2048
