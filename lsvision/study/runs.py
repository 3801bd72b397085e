"""Many noisy calibrations of a study's points: drawn, calibrated in batches, gathered."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from lsvision.report.progress import progress_bars
from lsvision.stages.calibration.calibrate import BatchCalibration, calibrate_batch
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.study.points import Conditions, ExactCorners, noise_chol

# Runs whose noise comes from one seed. Fixed, so that a run's noise does not depend on the batch it is calibrated in.
_BLOCK = 64
# Blocks of one study's seed; those of the next seed follow.
_BLOCKS_PER_SEED = 1_000_003


@dataclass(frozen=True)
class PointRuns:
    """All runs of one point: what each calibration found, and how its RMSE fell; ``(runs, ..)``, mm.

    ``rmse_path_mm`` is ``(iterations, runs)`` from the state before, and repeats the result past a run's last.
    """

    n: Tensor
    covariance: Tensor
    rmse_path_mm: Tensor
    iterations: Tensor
    converged: Tensor
    noise_scale: Tensor
    info: Tensor


@dataclass(frozen=True)
class Task:
    """Some runs of one point, calibrated as one batch."""

    point: int
    first: int
    last: int


def run_points(
    points: Sequence[Conditions],
    corners: Sequence[ExactCorners],
    config: CalibrationConfig,
    *,
    runs: int,
    batch: int,
    seed: int,
    threads: int,
) -> list[PointRuns]:
    """Calibrate ``runs`` noisy copies of every point's corners, ``batch`` at a time, on several threads.

    A run's noise follows from the seed and the run's number alone: every point sees the same draws, so that what
    differs between points is due to them, and neither the batch size nor the threads change a bit.
    """
    tasks = [
        Task(point, first, min(first + batch, runs)) for point in range(len(points)) for first in range(0, runs, batch)
    ]
    work = partial(_calibrate, points, corners, config, seed)
    found: list[list[BatchCalibration]] = [[] for _ in points]
    with progress_bars() as bars, _one_torch_thread(), ThreadPoolExecutor(threads) as pool:
        bar = bars.start("calibrate", total=len(points) * runs)
        for task, result in zip(tasks, pool.map(work, tasks), strict=True):
            found[task.point].append(result)
            bars.advance(bar, task.last - task.first)
    return [_joined(batches) for batches in found]


def noisy_points(corners: ExactCorners, conditions: Conditions, seed: int, first: int, last: int) -> Tensor:
    """Measured corners of runs ``first..last-1``: ``(runs, boards, corners, 3)``, mm."""
    blocks = range(first // _BLOCK, -(-last // _BLOCK))
    drawn = [_draws(corners, (seed * _BLOCKS_PER_SEED + block) % 2**32) for block in blocks]
    skip = first - blocks.start * _BLOCK
    white, phase = (torch.cat(parts)[skip : skip + last - first] for parts in zip(*drawn, strict=True))
    noisy = corners.points + white * noise_chol(conditions).diagonal()
    if conditions.vibration_mm == conditions.encoder_mm == 0:
        return noisy
    travel = corners.points[..., 1]
    vibration = conditions.vibration_mm * _wave(travel, conditions.vibration_wavelength_mm, phase[..., :2])
    encoder = conditions.encoder_mm * _wave(travel, conditions.encoder_wavelength_mm, phase[..., 2:])
    return noisy + torch.stack([vibration[..., 0], encoder[..., 0], vibration[..., 1]], dim=-1)


def _draws(corners: ExactCorners, seed: int) -> tuple[Tensor, Tensor]:
    """One block's white noise ``(runs, boards, corners, 3)`` and phases ``(runs, boards, 3)``.

    Board by board, so that the first boards of every placing see the same.
    """
    generator = torch.Generator().manual_seed(seed)
    boards, count = corners.points.shape[:2]
    phases, white = [], []
    for _ in range(boards):
        phases.append(2 * math.pi * torch.rand(_BLOCK, 3, generator=generator, dtype=torch.float64))
        white.append(torch.randn(_BLOCK, count, 3, generator=generator, dtype=torch.float64))
    return torch.stack(white, dim=1), torch.stack(phases, dim=1)


def _wave(travel: Tensor, wavelength_mm: float, phase: Tensor) -> Tensor:
    """Sine waves of rms one along the travel, ``(runs, boards, corners, waves)``."""
    angle = (2 * math.pi / wavelength_mm) * travel
    return math.sqrt(2.0) * torch.sin(angle[..., None] + phase[..., None, :])


def _calibrate(
    points: Sequence[Conditions], corners: Sequence[ExactCorners], config: CalibrationConfig, seed: int, task: Task
) -> BatchCalibration:
    conditions, exact = points[task.point], corners[task.point]
    measured = noisy_points(exact, conditions, seed, task.first, task.last)
    chol = noise_chol(conditions)
    covariance = (chol @ chol.mT).expand(*exact.points.shape, 3)
    with torch.inference_mode():
        return calibrate_batch(measured, covariance, exact.board_points, exact.valid, conditions.calibration(config))


def _joined(batches: Sequence[BatchCalibration]) -> PointRuns:
    longest = max(len(batch.rmse_path_mm) for batch in batches)
    paths = [
        torch.cat([path, path[-1:].expand(longest - len(path), -1)])
        for path in (batch.rmse_path_mm for batch in batches)
    ]
    fields = ("n", "covariance", "iterations", "converged", "noise_scale", "info")
    return PointRuns(
        rmse_path_mm=torch.cat(paths, dim=1),
        **{name: torch.cat([getattr(batch, name) for batch in batches]) for name in fields},
    )


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Batches are spread over threads; within one, torch's own would only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
