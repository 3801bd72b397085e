"""An archive through the engines, compared with the bare stages in one loop: lines per second, overhead, memory.

The time to start the workers and to import the package is not counted.
"""

import re
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch

from lsvision.archive import (
    LEDGER_FILE,
    WORK_FOLDER,
    Engine,
    Ledger,
    LocalEngine,
    Place,
    Processing,
    Task,
    find_scans,
    plan_run,
    process_scans,
    read_calibrations,
)
from lsvision.archive.engines.dask import DaskEngine
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import (
    NewScan,
    ProductLayout,
    product_writer,
    read_calibration,
    read_scan,
    write_calibration,
    write_scan,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import Calibration, Motion, Observability, Rig, Travel

RIG = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375)
SCANS, LINES = 2, 4096
TURNS = 3
WORKER_MEMORY_MB = 2048
PROCESSING = Processing(DisparityConfig(matcher="sgbm"), CorrectionConfig(), False, WORKER_MEMORY_MB)


@dataclass(frozen=True)
class Usage:
    """Peak memory, KiB, of the worker that runs the task, and its processor seconds as text."""

    number: int

    def run(self) -> tuple[int, float]:
        """Ask the system."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        # Since its program began: ``ru_maxrss`` begins with the peak of the process that started this one.
        peak = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[0]
        return int(peak), used.ru_utime + used.ru_stime


def make_archive(root: Path) -> Path:
    """Write scans of a textured plane near zero disparity and a calibration; return the calibration's path."""
    random = torch.Generator().manual_seed(0)
    for number in range(SCANS):
        noise = torch.rand(3, 1, LINES, RIG.width_px, generator=random)
        texture = torch.nn.functional.avg_pool2d(noise, 3, 1, 1)[:, 0].movedim(0, -1)
        left = ((texture - 0.5) * 400 + 128).clamp(0, 255).to(torch.uint8)
        write_scan(
            root / f"scan{number}",
            NewScan(rig=RIG, travel=Travel(0.28), left=[left], right=[left.roll(-4, 1)], lines=LINES),
        )
    motion = Motion(torch.tensor([0.02, 1.02, -0.01]).double(), 1e-8 * torch.eye(3).double())
    path = root / "calibration.json"
    write_calibration(Calibration("joint", motion, 1.0, 0.1, (), (), Observability((), ""), RIG), path)
    return path


def bare(archive: Path, calibration: Path, output: Path) -> float:
    """Seconds of the bare stages, scan after scan, with their products written."""
    motion, config = read_calibration(calibration).motion, PROCESSING.correction
    begin = time.perf_counter()
    for found in find_scans(str(archive)):
        scan = read_scan(found.path)
        grid = plan_product(scan, motion, config)
        layout = ProductLayout(grid, 3, torch.uint8, config.strip_rows, {})
        with product_writer(output / f"{found.key}.zarr", layout) as writer:
            for strip in correct_scan(scan, depth_of(scan, PROCESSING.disparity), motion, config, grid):
                writer.write(strip)
    return time.perf_counter() - begin


def through(engine: Engine, archive: Path, calibration: Path, output: Path) -> float:
    """Seconds of the same scans through an engine, with its ledger and depth store."""
    output.mkdir()
    begin = time.perf_counter()
    with Ledger(output / LEDGER_FILE) as ledger:
        plan = plan_run(find_scans(str(archive)), read_calibrations(calibration), PROCESSING, {}, output)
        rows = process_scans(plan.to_do, engine, Place(ledger, output, output / WORK_FOLDER, PROCESSING))
    if any(row.status != "done" for row in rows):
        raise RuntimeError(f"not every scan was done: {rows}")
    return time.perf_counter() - begin


def usage(engine: Engine, workers: int) -> tuple[int, float]:
    """Peak memory, MB, of the workers so far, and the processor seconds of the first worker and this process."""
    for number in range(workers):
        engine.submit(Task("usage", Usage(number)))
    found: list[tuple[int, float]] = []
    while len(found) < workers:
        found += [outcome.result for _, outcome in engine.collect()]
    return max(memory for memory, _ in found) >> 10, found[0][1] + time.process_time()


@contextmanager
def started(make: Callable[[], Engine], workers: int) -> Iterator[Engine]:
    """An engine whose workers have answered."""
    with make() as engine:
        usage(engine, workers)
        yield engine


def run() -> dict[str, object]:
    """Lines per second of the bare stages and of every engine, medians of alternating turns."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command that corrects one scan does, and every worker
    engines: dict[str, tuple[Callable[[], Engine], int]] = {
        "local_1": (lambda: LocalEngine(1), 1),
        "local_2": (lambda: LocalEngine(2), 2),
        "dask_1": (lambda: DaskEngine(None, 1, WORKER_MEMORY_MB), 1),
        "dask_2": (lambda: DaskEngine(None, 2, WORKER_MEMORY_MB), 2),
    }
    seconds: dict[str, list[float]] = {name: [] for name in engines}
    reference: dict[str, list[float]] = {name: [] for name in engines}
    processor: dict[str, list[float]] = {name: [] for name in engines}
    memory: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        calibration = make_archive(root / "archive")
        for name, (make, workers) in engines.items():
            with started(make, workers) as engine:
                for turn in range(TURNS):
                    before = time.process_time()
                    reference[name].append(bare(root / "archive", calibration, root / f"bare {name} {turn}"))
                    of_stages, (_, before) = time.process_time() - before, usage(engine, workers)
                    seconds[name].append(through(engine, root / "archive", calibration, root / f"{name} {turn}"))
                    memory[name], after = usage(engine, workers)
                    processor[name].append((after - before) / of_stages)
    ratio = {
        name: statistics.median(b / s for b, s in zip(reference[name], seconds[name], strict=True)) for name in engines
    }
    lines = SCANS * LINES
    best = statistics.median(value for values in reference.values() for value in values)
    return {
        "unit": f"lines of {RIG.width_px} px per second, matched and corrected",
        "bare": round(lines / best),
        **{name: round(lines / statistics.median(values)) for name, values in seconds.items()},
        "ratio": round(ratio["local_1"], 3),
        "overhead_percent": {name: round(100 * (1 / ratio[name] - 1), 1) for name in ("local_1", "dask_1")},
        "processor_overhead_percent": {
            name: round(100 * (statistics.median(processor[name]) - 1), 1) for name in ("local_1", "dask_1")
        },
        "two_over_one": {kind: round(ratio[f"{kind}_2"] / ratio[f"{kind}_1"], 2) for kind in ("local", "dask")},
        "worker_memory_mb": memory,
        "worker_memory_bound_mb": WORKER_MEMORY_MB,
    }
