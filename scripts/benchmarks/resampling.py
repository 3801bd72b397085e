"""Correction of full-width scans, compared with OpenCV in one run on one machine, on torch's default threads.

Colour and height of a surface in motion are resampled by ``sample_images`` and, with the same maps, by a bare
``cv2.remap``, both in strips from one scan to product rows. The correction that makes the maps is timed as well, and
so is a copy of the bytes of colour and height. A new process for each length of scan measures the memory.
"""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from lsvision.geometry import zero_disparity_mm
from lsvision.image.brightness import gray_bytes
from lsvision.image.resampling import SAMPLED_TILES, Interpolation, Resampler, Sampling, sample_images
from lsvision.image.tiling import in_parallel, keep_freed_memory, tiles
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import Correction, correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.disparity.match import disparity_range
from lsvision.types import DepthView, Motion, Rig, Scan, StereoPair, Travel

RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
PITCH = 0.07
LINES, MEMORY_LINES = 8192, (8192, 32768, 131072)
STEREO_LINES, STEREO_MEMORY_LINES = 4096, (8192, 32768)
STRIP = 512
TURNS = 3
MOTION = Motion(torch.tensor([-0.03, 1.02, 0.02], dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64))
CONFIG = CorrectionConfig(height_range_mm=(-30.0, 30.0), strip_rows=STRIP)
MATCHING = DisparityConfig(largest_sigma_px=0.2)


@dataclass(frozen=True)
class Repeated:
    """A tall image that repeats the same lines, without storing more than them."""

    lines: Tensor
    height: int

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.height, *self.lines.shape[1:]

    @property
    def dtype(self) -> torch.dtype:
        return self.lines.dtype

    def read(self, start: int, stop: int) -> Tensor:
        return self.lines[torch.arange(start, stop) % len(self.lines)]


@dataclass(frozen=True)
class ResamplingSpeeds:
    """Mpx/s of ours by interpolation and library and of a bare remap by interpolation; largest differences by unit."""

    ours: dict[str, float]
    remap: dict[str, float]
    largest_difference: dict[str, float]


def surface_scan(lines: int) -> Scan:
    """A wavy sheet with a raised block and missing depths, as from a camera that computes depth maps."""
    generator = torch.Generator().manual_seed(0)
    u, v = torch.arange(RIG.width_px), torch.arange(1024)[:, None]
    noise = torch.randn(1024, RIG.width_px, generator=generator)
    depth = 797.0 + 5 * torch.sin(v * (2 * torch.pi / 1024)) + 0.003 * u + 0.02 * noise
    depth[:, 2500:4500] -= 20.0
    depth[:, 300:360] = torch.nan
    color = torch.randint(0, 256, (1024, RIG.width_px, 3), dtype=torch.uint8, generator=generator)
    return Scan(Path("made"), RIG, Travel(PITCH), DepthView(Repeated(color, lines), Repeated(depth[..., None], lines)))


def run() -> dict[str, object]:
    """Mpx/s of both, their ratios, and megabytes at three lengths; ``ratio`` is that of bicubic colour and height."""
    keep_freed_memory()
    speeds = resampling_speeds()
    ratios = {name: round(speed / speeds.remap[name.split()[0]], 2) for name, speed in speeds.ours.items()}
    stereo = scan_speeds()
    return {
        "unit": "Mpx/s of the product",
        "resampling": {name: round(value, 1) for name, value in speeds.ours.items()},
        "cv2.remap": {name: round(value, 1) for name, value in speeds.remap.items()},
        "memcpy": round(memcpy_speed(), 1),
        "ratios": ratios,
        "ratio": ratios["bicubic grid_sample"],
        "largest_difference": speeds.largest_difference,
        "correction_of_a_depth_map_scan": round(depth_map_speed(), 2),
        "correction_of_a_stereo_scan": {name: round(value, 2) for name, value in stereo.items()},
        "stereo_ratios": {
            f"{ours} to {bare}": round(stereo[ours] / stereo[bare], 2)
            for bare in stereo
            if bare.startswith("sgbm")
            for ours in ("grid_sample", "opencv")
        },
        "megabytes": {str(lines): peak_megabytes(lines) for lines in MEMORY_LINES},
        "megabytes_of_a_stereo_scan": {str(lines): peak_megabytes(lines, "stereo") for lines in STEREO_MEMORY_LINES},
    }


def resampling_speeds() -> ResamplingSpeeds:
    """Sample a strip by ``sample_images`` and by a bare ``cv2.remap`` with the same maps."""
    scan = surface_scan(2048)
    grid = plan_product(scan, MOTION, CONFIG)
    strip = Correction(scan, depth_of(scan), MOTION, CONFIG, grid).strip((768, 768 + STRIP))
    source = strip.source
    start = int(source[..., 0].nan_to_num(nan=1e9).min()) - 4
    stop = int(source[..., 0].nan_to_num(nan=0.0).max()) + 5
    line, column = source[..., 0] - start, source[..., 1].contiguous()
    filled = [values.nan_to_num(nan=8.0).numpy() for values in (column, line)]  # cv2.remap cannot skip missing cells
    color = scan.left.read(start, stop)
    height = (zero_disparity_mm(RIG) - scan.images.depth.read(start, stop)).nan_to_num(nan=0.0)

    def ours(mode: Interpolation, resampler: Resampler) -> tuple[Tensor, Tensor]:
        made = torch.empty(*line.shape, 3, dtype=torch.uint8), torch.empty(*line.shape, 1)

        def fill(tile: tuple[slice, slice]) -> None:
            out = made[0][tile], made[1][tile]
            sample_images((color, height), column[tile], line[tile], Sampling(mode, resampler), out=out)

        in_parallel(fill, tiles(len(line), line.shape[1], SAMPLED_TILES[resampler]))
        return made

    def bare(mode: Interpolation) -> tuple[Tensor, Tensor]:
        flag = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}[mode]
        sampled = cv2.remap(color.numpy(), *filled, flag, borderMode=cv2.BORDER_REPLICATE)
        heights = cv2.remap(height.numpy(), *filled, flag, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(sampled), torch.from_numpy(heights)[..., None]

    modes: tuple[Interpolation, ...] = ("bilinear", "bicubic")
    resamplers: tuple[Resampler, ...] = ("grid_sample", "opencv")
    sides: dict[str, Callable[[], tuple[Tensor, Tensor]]] = {mode: lambda mode=mode: bare(mode) for mode in modes}
    sides |= {
        f"{mode} {with_}": lambda mode=mode, with_=with_: ours(mode, with_) for mode in modes for with_ in resamplers
    }
    speeds = {name: line.numel() / seconds / 1e6 for name, seconds in median_seconds(sides).items()}
    expected = bare("bilinear")
    found = ours("bilinear", "grid_sample")
    known = torch.isfinite(source[..., 0])
    largest = {
        "grey values": float((found[0].int() - expected[0].int())[known].abs().max()),
        "mm": float((found[1] - expected[1])[known].abs().max()),
    }
    return ResamplingSpeeds(
        ours={name: speeds[name] for name in speeds if " " in name},
        remap={mode: speeds[mode] for mode in modes},
        largest_difference=largest,
    )


def depth_map_speed() -> float:
    """Mpx/s of the whole correction of a depth-map scan, without files."""
    scan = surface_scan(LINES)
    grid = plan_product(scan, MOTION, CONFIG)
    begin = time.perf_counter()
    for _ in correct_scan(scan, depth_of(scan), MOTION, CONFIG, grid):
        pass
    return grid.rows * grid.columns / (time.perf_counter() - begin) / 1e6


def stereo_scan(lines: int) -> Scan:
    """A textured plane in two views, of any length."""
    generator = torch.Generator().manual_seed(0)
    texture = torch.randint(0, 256, (1024, RIG.width_px + 200, 3), dtype=torch.uint8, generator=generator)
    texture = torch.from_numpy(cv2.GaussianBlur(texture.numpy(), (0, 0), 1.5))
    left, right = (Repeated(texture[:, start : start + RIG.width_px].contiguous(), lines) for start in (100, 80))
    return Scan(Path("made"), RIG, Travel(PITCH), StereoPair(left, right))


def scan_speeds() -> dict[str, float]:
    """Mpx/s of correcting a stereo scan, matching included, and of OpenCV alone: SGBM over the same range and a remap.

    OpenCV's SGBM aggregates the costs of one pass in five directions on one thread, or in three on all threads.
    """
    scan = stereo_scan(STEREO_LINES)
    grid = plan_product(scan, MOTION, CONFIG)
    left, right = (image.read(0, 1024) for image in (scan.left, scan.images.right) if image is not None)
    maps = [values.astype(np.float32) + 0.3 for values in np.meshgrid(np.arange(7142.0), np.arange(1024.0))]
    gray = [gray_bytes(image).numpy() for image in (left, right)]
    low, high = disparity_range(RIG, MATCHING)
    count = high - low + 1 + -(high - low + 1) % 16

    def ours(resampler: Resampler) -> None:
        for _ in correct_scan(scan, depth_of(scan, MATCHING), MOTION, replace(CONFIG, resampler=resampler), grid):
            pass

    def one_pass(mode: int) -> None:
        matcher = cv2.StereoSGBM.create(low, count, 5, 200, 800, 10, 0, 5, 100, 1, mode)
        depth = matcher.compute(*gray).astype(np.float32)
        cv2.remap(left.numpy(), *maps, cv2.INTER_CUBIC)
        cv2.remap(depth, *maps, cv2.INTER_LINEAR)

    sides: dict[str, tuple[int, Callable[[], None]]] = {
        "grid_sample": (STEREO_LINES, lambda: ours("grid_sample")),
        "opencv": (STEREO_LINES, lambda: ours("opencv")),
        "sgbm of three directions and remap": (1024, lambda: one_pass(cv2.STEREO_SGBM_MODE_SGBM_3WAY)),
        "sgbm of five directions and remap": (1024, lambda: one_pass(cv2.STEREO_SGBM_MODE_SGBM)),
    }
    seconds = median_seconds({name: side for name, (_, side) in sides.items()}, turns=1)
    return {name: lines * RIG.width_px / seconds[name] / 1e6 for name, (lines, _) in sides.items()}


def memcpy_speed() -> float:
    """Mpx/s of copying colour and height, seven bytes per pixel."""
    source = torch.zeros(7 * STRIP * RIG.width_px, dtype=torch.uint8)
    target = torch.empty_like(source)
    seconds = median_seconds({"copy": lambda: target.copy_(source)})["copy"]
    return STRIP * RIG.width_px / seconds / 1e6


def median_seconds(sides: dict[str, Callable[[], object]], turns: int = TURNS) -> dict[str, float]:
    """Median seconds of each side; the sides take turns, so that a slow moment of the machine affects all of them."""
    taken: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(turns + 1):
        for name, side in sides.items():
            begin = time.perf_counter()
            side()
            if turn > 0 or turns == 1:
                taken[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in taken.items()}


def peak_megabytes(lines: int, kind: str = "depth") -> int:
    """Peak memory, MB, of a process that corrects a scan of the given length, with a depth map or stereo."""
    code = f"import resampling; resampling.correct_and_report({lines}, {kind!r})"
    folder = str(Path(__file__).parent)
    result = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return int(json.loads(result.stdout.splitlines()[-1]))


def correct_and_report(lines: int, kind: str) -> None:
    """Correct a scan and print the peak memory of the process, MB."""
    keep_freed_memory()
    scan = stereo_scan(lines) if kind == "stereo" else surface_scan(lines)
    for _ in correct_scan(scan, depth_of(scan, MATCHING), MOTION, CONFIG):
        pass
    # Not getrusage: its maximum includes that of the parent process.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) // 1024)
