"""Small archives on disk, and what was made of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from lsvision.archive import (
    LEDGER_FILE,
    WORK_FOLDER,
    Engine,
    Ledger,
    LocalEngine,
    Place,
    Processing,
    ScanRow,
    find_scans,
    plan_run,
    process_scans,
    read_calibrations,
)
from lsvision.geometry import zero_disparity_mm
from lsvision.io import NewScan, read_product, write_calibration, write_scan
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import LINE_COMPONENTS, Calibration, LineFinding, LineMotion, Motion, Observability, Rig, Travel

WIDTH = 64
RIG = Rig(WIDTH, 1120.0, 113.84, 354.0, 8.8, 54.0)
PROCESSING = Processing(
    DisparityConfig(block_lines=32, halo_lines=8, strip_lines=32),
    CorrectionConfig(strip_rows=64),
    False,
    worker_memory_mb=3072,
)


def make_scan(folder: Path, lines: int = 96, seed: int = 0, *, stereo: bool = False, **options) -> Path:
    """A scan of random colours: with a depth map, or a right image that the left one is a shifted copy of."""
    random = torch.Generator().manual_seed(seed)
    left = torch.randint(1, 256, (lines, WIDTH, 3), generator=random).to(torch.uint8)
    depth = zero_disparity_mm(RIG) + 5.0 * torch.rand(lines, WIDTH, 1, generator=random)
    write_scan(
        folder,
        NewScan(
            rig=options.pop("rig", RIG),
            travel=Travel(1.12),
            left=[left],
            right=[left.roll(1, dims=1)] if stereo else None,
            depth=None if stereo else [depth],
            lines=lines,
            **options,
        ),
    )
    return folder


def touch(root: Path, *names: str) -> None:
    """Folders that look like scans from outside."""
    for name in names:
        (root / name).mkdir(parents=True)
        (root / name / "scan.yaml").write_text("")


def shaken(lines: int = 96, *components: str) -> LineMotion:
    """A motion of some components, or of all but dy, with what was found."""
    components = components or ("dx", "dz", "roll")
    random = torch.Generator().manual_seed(lines)
    size = torch.tensor([0.3, 0.4, 2e-3, 0.2], dtype=torch.float64)
    there = torch.tensor([name in components for name in LINE_COMPONENTS])
    values = torch.randn(lines, 4, generator=random, dtype=torch.float64) * size * there
    covariance = torch.diag((0.2 * size * there).square()).repeat(lines, 1, 1)
    rms = values.square().mean(0).sqrt().tolist()
    findings = tuple(
        LineFinding(name, "corrected", rms[i], 0.2 * float(size[i])) if there[i] else LineFinding(name, "absent")
        for i, name in enumerate(LINE_COMPONENTS)
    )
    return LineMotion(values, covariance, findings)


def make_calibration(path: Path, n: Sequence[float] = (0.02, 1.02, -0.01), rig: Rig = RIG) -> Path:
    """A calibration that says nothing but its motion."""
    motion = Motion(torch.tensor(n, dtype=torch.float64), 1e-8 * torch.eye(3, dtype=torch.float64))
    write_calibration(Calibration("joint", motion, 1.0, 0.1, (), (), Observability((), ""), rig), path)
    return path


class InProcess:
    """An engine that runs tasks in this process, the last one first, and counts them."""

    def __init__(self, capacity: int = 4) -> None:
        self.capacity = capacity
        self.tasks: list = []
        self._waiting: list = []

    def __enter__(self) -> "InProcess":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, task) -> None:
        self._waiting.append(task)

    def collect(self):
        from lsvision.archive.tasks import run_task

        task = self._waiting.pop()
        self.tasks.append(task)
        return [(task, run_task(task))]


def process(
    archive: Path,
    calibration: Path,
    output: Path,
    engine: Engine | None = None,
    processing: Processing = PROCESSING,
    on_done: Callable = lambda task, outcome: None,
    verify: bool = False,
) -> tuple[list[ScanRow], Engine]:
    """Process an archive with an engine; returns the rows of the processed scans and the engine."""
    output.mkdir(exist_ok=True)
    with Ledger(output / LEDGER_FILE) as ledger:
        plan = plan_run(
            find_scans(str(archive), output), read_calibrations(calibration), processing, ledger.scans(), output
        )
        place = Place(ledger, output, output / WORK_FOLDER, processing, verify=verify)
        with engine or InProcess() as running:
            return process_scans(plan.to_do, running, place, on_done), running


def with_strip_rows(rows: int) -> Processing:
    """The same processing in strips of another height."""
    return replace(PROCESSING, correction=replace(PROCESSING.correction, strip_rows=rows))


def assert_same_products(one: Path, other: Path) -> None:
    """Every product of an output is there in the other, bit for bit."""
    names = sorted(path.relative_to(one) for path in one.rglob("*.zarr") if ".work" not in path.parts)
    assert names
    for name in names:
        a, b = read_product(one / name), read_product(other / name)
        assert (a.shape, a.pitch_mm, a.origin_mm) == (b.shape, b.pitch_mm, b.origin_mm)
        for plane in ("color", "height", "valid", "source"):
            ours, theirs = getattr(a, plane)(0, a.shape[0]), getattr(b, plane)(0, b.shape[0])
            assert ours.numpy().tobytes() == theirs.numpy().tobytes(), (name, plane)


def local(workers: int) -> LocalEngine:
    """Worker processes."""
    return LocalEngine(workers)
