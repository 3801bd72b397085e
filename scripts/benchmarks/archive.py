"""A mixed archive through the commands: are all products bit-equal on any engine, workers and strips? And a rerun?

The archive has 200 small scans, half of them with a depth map, and one of 131 072 lines of 1786 px, all of repeated
random texture. The benchmark takes some minutes and 20 GB of disk.
"""

import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from lsvision.geometry import zero_disparity_mm
from lsvision.io import NewScan, read_product, write_calibration, write_scan
from lsvision.types import Calibration, Motion, Observability, Rig, Travel

RIG = Rig(1786, 40.0, 113.84, 354.0, 260.125, 1524.375)
SMALL, SMALL_LINES, LARGE_LINES, PATTERN_LINES, PITCH = 200, 64, 131_072, 4096, 0.28
SHIFT_PX = 4
PLANES = ("color", "height", "valid", "source")
RUNS = {
    "local, 2 workers": ("engine=local", "engine.workers=2"),
    "local, 1 worker, other strips": (
        "engine=local",
        "engine.workers=1",
        "disparity.strip_lines=3000",
        "correction.strip_rows=256",
    ),
    "dask, 2 workers": ("engine=dask", "engine.workers=2"),
}


def run() -> dict[str, object]:
    """Seconds of every run from scratch and of an unchanged rerun, and whether all products are equal."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        calibration = _make_archive(root / "archive")
        seconds, digests = {}, []
        for number, (name, options) in enumerate(RUNS.items()):
            output = root / f"output{number}"
            seconds[name] = _reprocess(root, calibration, output, *options)
            digests.append(_digests(output))
            if number == 0:
                before = _files(output)
                seconds["unchanged rerun"] = _reprocess(root, calibration, output, *options)
                untouched = _files(output) == before
    return {
        "products": len(digests[0]),
        "equal": all(digest == digests[0] for digest in digests),
        "rerun_writes_nothing": untouched,
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
    }


def _make_archive(root: Path) -> Path:
    """Write scans of a texture near the plane of zero disparity and a calibration; return the calibration's path."""
    random = torch.Generator().manual_seed(0)
    noise = torch.rand(3, 1, PATTERN_LINES, RIG.width_px, generator=random)
    texture = torch.nn.functional.avg_pool2d(noise, 3, 1, 1)[:, 0].movedim(0, -1)
    left = ((texture - 0.5) * 400 + 128).clamp(0, 255).to(torch.uint8)
    right = left.roll(-SHIFT_PX, 1)
    depth = torch.full((SMALL_LINES, RIG.width_px, 1), zero_disparity_mm(RIG) - 1.0)
    for number in range(SMALL):
        lines = slice(number * 16, number * 16 + SMALL_LINES)
        stereo = number % 2 == 1
        write_scan(
            root / f"small{number:03}",
            NewScan(
                rig=RIG,
                travel=Travel(PITCH),
                left=[left[lines]],
                right=[right[lines]] if stereo else None,
                depth=None if stereo else [depth],
                lines=SMALL_LINES,
            ),
        )
    repeats = LARGE_LINES // PATTERN_LINES
    write_scan(
        root / "large",
        NewScan(rig=RIG, travel=Travel(PITCH), left=[left] * repeats, right=[right] * repeats, lines=LARGE_LINES),
    )
    motion = Motion(torch.tensor([0.02, 1.02, -0.01]).double(), 1e-8 * torch.eye(3).double())
    path = root / "calibration.json"
    write_calibration(Calibration("joint", motion, 1.0, 0.1, (), (), Observability((), ""), RIG), path)
    return path


def _reprocess(root: Path, calibration: Path, output: Path, *options: str) -> float:
    begin = time.perf_counter()
    subprocess.run(
        [
            sys.executable, "-m", "lsvision.run", "+experiment=reprocess", f"archive={root / 'archive'}",
            f"calibration={calibration}", f"output={output}", f"hydra.run.dir={root / 'run'}",
            *options,
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    return time.perf_counter() - begin


def _digests(output: Path) -> dict[str, str]:
    """A hash of the content of every product, which does not depend on its chunks."""
    found = {}
    for path in sorted(output.glob("*.zarr")):
        product, digest = read_product(path), hashlib.sha256()
        for plane in PLANES:
            for row in range(0, product.shape[0], 2048):
                digest.update(getattr(product, plane)(row, min(row + 2048, product.shape[0])).numpy().tobytes())
        found[path.stem] = digest.hexdigest()
    return found


def _files(output: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in output.rglob("*") if path.is_file()}
