"""Scans of any length: planned, corrected and validated in memory that does not grow with them."""

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lsvision.archive import planned
from lsvision.archive.identity import ScanFiles
from lsvision.archive.sources.calibrations import read_calibrations
from lsvision.archive.sources.catalogue import Found
from lsvision.errors import FileFormatError
from lsvision.geometry import zero_disparity_mm
from lsvision.io import NewScan, write_scan
from lsvision.types import DepthView, Rig, Scan, Travel
from tests.archive.archives import PROCESSING, WIDTH, make_calibration
from tests.archive.archives import RIG as SMALL_RIG
from tests.stages.correction.test_grid import Endless

RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)


def plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, megabytes: int | None, **changes) -> planned.PlannedScan:
    """Plan a full-size scan of 70 000 lines that was never written."""
    left = Endless((70_000, 7142, 3), 100, torch.uint8)
    depth = Endless((70_000, 7142, 1), zero_disparity_mm(RIG), torch.float32)
    scan = Scan(tmp_path, RIG, Travel(0.07), DepthView(left, depth))
    monkeypatch.setattr(planned, "read_scan", lambda *_, **__: scan)
    monkeypatch.setattr(planned, "stamp_of", lambda _: "stamp")
    n = changes.pop("n", (0.0, 1.0246, 0.0))
    calibrations = read_calibrations(make_calibration(tmp_path / "calibration.json", n, RIG))
    correction = replace(PROCESSING.correction, **changes)
    processing = replace(PROCESSING, worker_memory_mb=megabytes, correction=correction)
    return planned.plan_scan(Found("s", tmp_path), calibrations, processing)


def test_a_stretched_scan_of_70_000_lines_fits_a_worker(monkeypatch, tmp_path):
    scan = plan(monkeypatch, tmp_path, 2048, strip_rows=512)
    assert scan.correction.strip_rows == 512
    assert scan.files == ScanFiles(str(tmp_path), "stamp", 70_000, False)
    assert scan.cell_bytes == 3 + 4 + 1 + 16


def test_coarse_and_fine_cells_are_counted(monkeypatch, tmp_path):
    """A row of coarse cells reads many lines, a row of fine ones has many cells."""
    assert plan(monkeypatch, tmp_path, 2048, strip_rows=512, pitch_mm=0.7).correction.strip_rows == 128
    assert plan(monkeypatch, tmp_path, 2048, strip_rows=512, pitch_mm=0.01).correction.strip_rows == 128


@pytest.mark.parametrize("megabytes", [2048, None])
def test_a_line_whose_skew_no_memory_holds(monkeypatch, tmp_path, megabytes):
    """Also of a single scan, which may take all the memory that there is."""
    monkeypatch.setattr(planned.psutil, "virtual_memory", lambda: type("Memory", (), {"total": 2 << 30}))
    with pytest.raises(FileFormatError, match=r"a worker needs \d+ MB for 32 rows of \d+ px, it may take"):
        plan(monkeypatch, tmp_path, megabytes, n=(0.0, 1.0, 8.0), height_range_mm=(-400.0, 400.0))


# Peak memory, MB, of planning, correcting and validating a scan, one after the other.
PEAK = """
import sys
from pathlib import Path
from lsvision.experiments.correct import CorrectSettings, run_correct
from lsvision.experiments.validate import ValidateSettings, run_validate
from lsvision.types import Board
from lsvision.archive import plan_one
from tests.archive.archives import PROCESSING
from tests.memory import peak_memory_mb as peak
from dataclasses import replace
import torch
torch.set_num_threads(1)
scan, calibration, output = map(Path, sys.argv[1:])
correction = replace(PROCESSING.correction, strip_rows=512)
peaks = []
plan_one(scan, calibration, PROCESSING)
peaks.append(peak())
run_correct(CorrectSettings(name="correct", scan=str(scan), calibration=str(calibration), output=str(output),
                            disparity=PROCESSING.disparity, correction=correction, line_motion="none"), output / "run")
peaks.append(peak())
run_validate(ValidateSettings(name="validate", product=str(output / "scan.zarr"), board=Board(12, 9, 90.0)),
             output / "run")
print(*peaks, peak())
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(resource, "RUSAGE_SELF"), reason="no peak memory on this platform")
def test_memory_does_not_grow_with_the_length(tmp_path):
    calibration = make_calibration(tmp_path / "calibration.json", (0.02, 1.0246, -0.03))
    z0, peaks = zero_disparity_mm(SMALL_RIG), []
    for lines in (4_000, 24_000):
        folder = tmp_path / str(lines) / "scan"
        travel = Travel(7.8, 7.8 * torch.arange(lines).double() + torch.sin(torch.arange(lines).double() / 50))
        write_scan(
            folder,
            NewScan(
                rig=SMALL_RIG,
                travel=travel,
                left=(torch.randint(1, 256, (500, WIDTH, 3)).to(torch.uint8) for _ in range(lines // 500)),
                right=None,
                depth=(z0 + torch.rand(500, WIDTH, 1) for _ in range(lines // 500)),
                lines=lines,
            ),
        )
        arguments = [sys.executable, "-c", PEAK, str(folder), str(calibration), str(tmp_path / str(lines))]
        done = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=200)
        assert done.returncode == 0, done.stderr
        peaks.append([float(value) for value in done.stdout.split()[-3:]])
    # 36 bytes a line: the encoder log and what is made of its text, and where the strips of the files lie.
    for short, long in zip(*peaks, strict=True):
        assert long < 1.1 * short + 20, peaks
