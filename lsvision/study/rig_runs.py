"""Many calibrations of simulated raw rigs: errors against what is stated, point by point."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import polars
import torch
from torch import Tensor

from lsvision.geometry import ideal_rig, sharp_depth_mm
from lsvision.report.progress import progress_bars
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import SHARED, RigPrior, Shared
from lsvision.stages.rig.solve import RigSolution, solve_rig
from lsvision.study.rig_bound import information_of_corners, least_factor
from lsvision.study.rig_scans import RigConditions, rig_scans
from lsvision.types import Board

_BATCH = 32  # runs at once: some 100 MB with sixteen boards


@dataclass(frozen=True)
class RigSampling:
    """How many rigs are drawn for every point, and from which seed."""

    runs: int
    seed: int = 0


def run_rigs(
    points: Sequence[RigConditions],
    prior: RigPrior,
    drawn: RigPrior,
    board: Board,
    config: RigConfig,
    sampling: RigSampling,
) -> polars.DataFrame:
    """One row per point: its conditions, and the figures of merit over its runs.

    Args:
        prior: of the calibrations. drawn: distribution that the true rigs and motions are drawn from.

    ``height_error_um`` is the rms bend of heights over the runs, ``stated_um`` that which the calibrations state,
    ``bound_um`` the least that any estimate of rigs so drawn can have (``rig_bound``), and ``over_bound`` the first
    over the last: 1 where a calibration is as good as can be, which it can be where prior and drawn are the same;
    ``nees`` is the normalised error of all quantities and n, ``unknowns`` on average where the stated covariance is
    right, and within ``nees_band`` of that in 997 studies of 1000;
    ``within_3_sigma`` is the share of all errors of quantities that are, 0.9973 if normal, and ``largest_z`` the
    largest of them.
    """
    start = prior.shared(torch.zeros_like(prior.mean))
    shape = HeightShape.of(prior.rig, start, prior.sigma, config.depth_range_mm or sharp_depth_mm(ideal_rig(prior.rig)))
    rows = []
    with progress_bars() as bars:
        bar = bars.start("calibrate rigs", total=len(points) * sampling.runs)
        for index, conditions in enumerate(points):
            torch.manual_seed(sampling.seed * len(points) + index)
            batches = []
            for first in range(0, sampling.runs, _BATCH):
                count = min(_BATCH, sampling.runs - first)
                scans = rig_scans(drawn, board, conditions, count)
                solution = solve_rig(scans.sightings, prior, config)
                least = drawn.root @ least_factor(information_of_corners(scans, drawn), conditions.off)
                bound_mm = shape.stated_mm(prior.over_sigma(least.mT).mT)
                batches.append(_figures(solution, scans.truth, shape, bound_mm))
                bars.advance(bar, count)
            rows.append({**asdict(conditions), "runs": sampling.runs, **_merits(polars.concat(batches))})
    return polars.DataFrame(rows, infer_schema_length=None)


def _figures(solution: RigSolution, truth: Shared, shape: HeightShape, bound_mm: Tensor) -> polars.DataFrame:
    """One row per run."""
    error, covariance = solution.shared.vector - truth.vector, solution.covariance
    z = (error / covariance.diagonal(dim1=-2, dim2=-1).sqrt()).abs()
    columns = {
        "bend_um": 1e3 * shape.bend_mm(solution.model.prior.over_sigma(error)),
        "stated_um": 1e3 * shape.stated_mm(solution.factor),
        "bound_um": 1e3 * bound_mm,
        "nees": (error * torch.linalg.solve(covariance, error)).sum(-1),
        "within_3_sigma": (z <= 3).double().mean(-1),
        "largest_z": z.amax(-1),
        "noise_scale": solution.noise_scale,
        "converged": solution.found.converged.double(),
    }
    return polars.DataFrame({name: values.numpy() for name, values in columns.items()})


def _merits(runs: polars.DataFrame) -> dict[str, float]:
    """Figures of merit over the runs of one point."""
    bend, stated, bound = ((polars.col(name) ** 2).mean().sqrt() for name in ("bend_um", "stated_um", "bound_um"))
    found = runs.select(
        bend.alias("height_error_um"),
        stated.alias("stated_um"),
        bound.alias("bound_um"),
        (bend / bound).alias("over_bound"),
        polars.col("nees").mean(),
        polars.col("within_3_sigma").mean(),
        polars.col("largest_z").max(),
        polars.col("noise_scale").mean(),
        polars.col("converged").mean(),
    )
    band = 3 * math.sqrt(2 * SHARED / len(runs))
    return {**found.row(0, named=True), "unknowns": float(SHARED), "nees_band": band}
