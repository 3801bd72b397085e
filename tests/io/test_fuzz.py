"""Damaged files of every kind that a command reads: read, or one line, in little memory and time."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource")

INPUTS = 2600


@pytest.mark.slow  # formats/test_mutated and images/test_line_image have quick ones
def test_damage_is_one_line_within_limits(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "tests.io.fuzz", str(tmp_path), str(INPUTS)],
        capture_output=True, text=True, check=False, timeout=300, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["faults"] == []
    assert result["inputs"] >= INPUTS
    assert result["peak_mb"] < 2048
