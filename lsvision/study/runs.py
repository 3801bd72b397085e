"""Many noisy calibrations of a study's points: drawn, calibrated in batches, joined."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.tiling import one_torch_thread
from lsvision.report.progress import progress_bars
from lsvision.stages.calibration.calibrate import BatchCalibration, calibrate_batch, calibrate_edges
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.measurements import BoardMeasurements
from lsvision.study.edges import with_noise
from lsvision.study.points import Conditions, ExactCorners, noise_chol
from lsvision.types import BoardEdges

# Runs whose noise comes from one generator. Fixed, so that a run's noise does not depend on its batch.
_BLOCK = 64
# Block b of a study with seed s draws from a generator seeded s * _BLOCKS_PER_SEED + b.
_BLOCKS_PER_SEED = 1_000_003
_SEEDS = 2**32
# The noise of a run's edges comes from a generator of its own, this far from that of the block of the same number.
_OF_EDGES = 2**31


@dataclass(frozen=True)
class PointRuns:
    """All runs of one point, the fields as in ``BatchCalibration``.

    ``rmse_path_mm`` starts with the state before, and repeats the result past a run's last iteration.
    """

    n: Float[Tensor, "runs 3"]
    covariance: Float[Tensor, "runs 3 3"]
    rmse_path_mm: Float[Tensor, "iterations runs"]
    iterations: Int[Tensor, " runs"]
    converged: Bool[Tensor, " runs"]
    noise_scale: Float[Tensor, " runs"]
    along_scan_rms_mm: Float[Tensor, "runs 4"]
    info: Int[Tensor, " runs"]

    @classmethod
    def join(cls, batches: Sequence[BatchCalibration]) -> "PointRuns":
        """The runs of all batches of one point."""
        longest = max(len(batch.rmse_path_mm) for batch in batches)
        paths = [
            torch.cat([path, path[-1:].expand(longest - len(path), -1)])
            for path in (batch.rmse_path_mm for batch in batches)
        ]
        fields = ("n", "covariance", "iterations", "converged", "noise_scale", "along_scan_rms_mm", "info")
        return cls(
            rmse_path_mm=torch.cat(paths, dim=1),
            **{name: torch.cat([getattr(batch, name) for batch in batches]) for name in fields},
        )


@dataclass(frozen=True)
class Sampling:
    """How many calibrations are made of every point, from which seed, and how they are run.

    ``batch`` runs are calibrated at once, each batch on one of ``threads`` threads; neither changes a bit.
    """

    runs: int
    batch: int = 256
    seed: int = 0
    threads: int = 1


@dataclass(frozen=True)
class _Batch:
    """Runs ``first..last-1`` of one point, calibrated at once; one run where it has edges besides."""

    point: int
    conditions: Conditions
    corners: ExactCorners
    first: int
    last: int

    @classmethod
    def all_of(cls, point: int, conditions: Conditions, corners: ExactCorners, sampling: "Sampling") -> list["_Batch"]:
        """The batches of a point."""
        runs, size = sampling.runs, 1 if corners.edges else sampling.batch
        return [cls(point, conditions, corners, first, min(first + size, runs)) for first in range(0, runs, size)]

    def calibrate(self, config: CalibrationConfig, seed: int) -> BatchCalibration:
        """The calibrations of the runs."""
        corners, options = self.corners, self.conditions.calibration(config)
        points = noisy_points(corners, self.conditions, seed, self.first, self.last)
        chol = noise_chol(self.conditions)
        covariance = (chol @ chol.mT).expand(*corners.points.shape, 3)
        with torch.inference_mode():
            if not corners.edges:
                return calibrate_batch(points, covariance, corners.board_points, corners.valid, options)
            measured = BoardMeasurements(points[0], covariance, corners.board_points, corners.valid)
            edges = noisy_edges(corners, self.conditions, seed, self.first)
            return calibrate_edges(measured, edges, options).as_batch_of_one()


def run_points(
    points: Sequence[Conditions], corners: Sequence[ExactCorners], config: CalibrationConfig, sampling: Sampling
) -> list[PointRuns]:
    """Calibrate noisy copies of every point's corners, in batches on several threads.

    A run's noise follows from the seed and the run's number alone: every point gets the same draws, so that
    differences between points are due to their conditions.
    """
    batches = [
        batch
        for index, point in enumerate(zip(points, corners, strict=True))
        for batch in _Batch.all_of(index, *point, sampling)
    ]
    found: list[list[BatchCalibration]] = [[] for _ in points]
    with progress_bars() as bars, one_torch_thread(), ThreadPoolExecutor(sampling.threads) as pool:
        bar = bars.start("calibrate", total=len(points) * sampling.runs)
        results = pool.map(lambda batch: batch.calibrate(config, sampling.seed), batches)
        for batch, result in zip(batches, results, strict=True):
            found[batch.point].append(result)
            bars.advance(bar, batch.last - batch.first)
    return [PointRuns.join(of_point) for of_point in found]


def noisy_points(
    corners: ExactCorners, conditions: Conditions, seed: int, first: int, last: int
) -> Float[Tensor, "runs boards corners 3"]:
    """Measured corners (x, travel, z), mm, of runs ``first..last-1``."""
    white, phase = _draws_of_runs(corners, seed, first, last)
    noisy = corners.points + white * noise_chol(conditions).diagonal()
    return noisy + _disturbance(corners.points[..., 1], conditions, phase)


def noisy_edges(corners: ExactCorners, conditions: Conditions, seed: int, run: int) -> list[BoardEdges]:
    """Measured edges of the boards of one run, disturbed as its corners are."""
    _, phase = _draws_of_runs(corners, seed, run, run + 1)
    generator = torch.Generator().manual_seed((seed * _BLOCKS_PER_SEED + run + _OF_EDGES) % _SEEDS)
    sigma_mm = torch.tensor([conditions.corner_sigma_mm, conditions.depth_sigma_mm], dtype=torch.float64)
    noisy = (with_noise(edges, sigma_mm, generator) for edges in corners.edges)
    return [
        replace(edges, points=edges.points + _disturbance(exact.points[:, 1], conditions, phase[0, board]))
        for board, (edges, exact) in enumerate(zip(noisy, corners.edges, strict=True))
    ]


def _disturbance(
    travel: Float[Tensor, "*#batch points"], conditions: Conditions, phase: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch points 3"]:
    """What vibration and encoder displace measured points by, mm: those at one travel alike."""
    vibration = conditions.vibration_mm * _wave(travel, conditions.vibration_wavelength_mm, phase[..., :2])
    encoder = conditions.encoder_mm * _wave(travel, conditions.encoder_wavelength_mm, phase[..., 2:])
    return torch.stack([vibration[..., 0], encoder[..., 0], vibration[..., 1]], dim=-1)


def _draws_of_runs(corners: ExactCorners, seed: int, first: int, last: int) -> tuple[Tensor, Tensor]:
    """White noise ``(runs, boards, corners, 3)`` and phases ``(runs, boards, 3)`` of runs ``first..last-1``."""
    blocks = range(first // _BLOCK, -(-last // _BLOCK))
    drawn = [_draws(corners, (seed * _BLOCKS_PER_SEED + block) % _SEEDS) for block in blocks]
    skip = first - blocks.start * _BLOCK
    white, phase = (torch.cat(parts)[skip : skip + last - first] for parts in zip(*drawn, strict=True))
    return white, phase


def _draws(corners: ExactCorners, seed: int) -> tuple[Tensor, Tensor]:
    """White noise ``(runs, boards, corners, 3)`` and phases ``(runs, boards, 3)`` of one block.

    Drawn board by board, so that the first boards of every placing get the same.
    """
    generator = torch.Generator().manual_seed(seed)
    boards, count = corners.points.shape[:2]
    phases, white = [], []
    for _ in range(boards):
        phases.append(2 * math.pi * torch.rand(_BLOCK, 3, generator=generator, dtype=torch.float64))
        white.append(torch.randn(_BLOCK, count, 3, generator=generator, dtype=torch.float64))
    return torch.stack(white, dim=1), torch.stack(phases, dim=1)


def _wave(travel: Tensor, wavelength_mm: float, phase: Tensor) -> Tensor:
    """Sine waves along the travel whose rms is one, ``(*batch, points, waves)``."""
    angle = (2 * math.pi / wavelength_mm) * travel
    return math.sqrt(2.0) * torch.sin(angle[..., None] + phase[..., None, :])
