"""The tables of a study: one row per run, one per point, one per iteration of a point."""

from collections.abc import Sequence
from dataclasses import asdict

import polars
import torch
from torch import Tensor

from lsvision.estimation import Info, cramer_rao_bound, nees
from lsvision.stages.calibration.observability import OBSERVED_SHARE
from lsvision.study.points import Conditions, ExactCorners, true_information
from lsvision.study.runs import PointRuns

# Quantiles of the RMSE at an iteration, over the runs.
_QUANTILES = {"low": 0.05, "median": 0.5, "high": 0.95}


def runs_table(
    points: Sequence[Conditions], corners: Sequence[ExactCorners], runs: Sequence[PointRuns]
) -> polars.DataFrame:
    """One row per calibration: n with its error and sigma, RMSE, whether it converged, whether its prior decides it."""
    return polars.concat([_run_rows(i, *point) for i, point in enumerate(zip(points, corners, runs, strict=True))])


def points_table(
    points: Sequence[Conditions], corners: Sequence[ExactCorners], runs: polars.DataFrame
) -> polars.DataFrame:
    """One row per point: its conditions, and the figures of merit over its runs that gave a result.

    ``rms_``, ``bias_`` and ``std_`` are those of the error of each component of n, ``sigma_`` is the mean sigma that
    the calibrations state, ``bound_`` the Cramér-Rao bound, prior included. ``error_over_bound`` is the root of the
    mean squared error in units of the bound, over all components: 1 for an efficient method. ``nees`` is 3 where the
    stated covariance is right. ``along_scan`` is the share of runs that found errors along the scan, and
    ``along_scan_rms_mm`` their mean size in the component where they are largest.
    """
    rows = []
    for index, (conditions, exact) in enumerate(zip(points, corners, strict=True)):
        of_point = runs.filter(polars.col("point") == index)
        solved = of_point.filter(polars.col("error_n1").is_finite())
        error = torch.from_numpy(solved.select("error_n1", "error_n2", "error_n3").to_numpy())
        sigma = solved.select("sigma_n1", "sigma_n2", "sigma_n3")
        bound = _bound(exact, conditions)
        scaled = nees(error, torch.linalg.cholesky(bound).expand(len(error), 3, 3))
        row = {"point": index, **asdict(conditions), "board_count": len(exact.points), "corners": exact.valid.numel()}
        row |= {"tilt_spread_deg": exact.tilt_spread_deg, "depth_span_mm": exact.depth_span_mm, "runs": len(of_point)}
        row |= _by_component("rms", error.square().mean(0).sqrt())
        row |= _by_component("bias", error.mean(0))
        row |= _by_component("std", error.std(0))
        row |= sigma.mean().row(0, named=True)
        row |= _by_component("bound", bound.diagonal().sqrt())
        row |= {"error_over_bound": float((scaled.mean() / 3).sqrt()), **_means(of_point, solved)}
        rows.append(row)
    return polars.DataFrame(rows, infer_schema_length=None)


def iterations_table(runs: Sequence[PointRuns]) -> polars.DataFrame:
    """One row per iteration of a point: quantiles of the RMSE over the runs, mm; iteration 0 is before calibration."""
    rows = []
    for index, point in enumerate(runs):
        quantiles = point.rmse_path_mm.nanquantile(torch.tensor(list(_QUANTILES.values())).double(), dim=1)
        for iteration, values in enumerate(quantiles.mT.tolist()):
            rows.append({"point": index, "iteration": iteration, **dict(zip(_QUANTILES, values, strict=True))})
    return polars.DataFrame(rows)


def _run_rows(index: int, conditions: Conditions, corners: ExactCorners, runs: PointRuns) -> polars.DataFrame:
    count = len(runs.n)
    failed = runs.info == int(Info.SINGULAR)
    eye = torch.eye(3, dtype=runs.n.dtype)
    covariance = torch.where(failed[:, None, None], eye, runs.covariance)
    error = runs.n - corners.n
    normalised = nees(error, torch.linalg.cholesky(covariance))
    widest = torch.linalg.eigvalsh(covariance)[:, -1].sqrt() / conditions.prior_sigma
    columns = {
        "point": torch.full((count,), index),
        "run": torch.arange(count),
        **_columns("n", runs.n),
        **_columns("error_n", error),
        **_columns("sigma_n", runs.covariance.diagonal(dim1=-2, dim2=-1).sqrt()),
        "rmse_before_mm": runs.rmse_path_mm[0],
        "rmse_after_mm": runs.rmse_path_mm[-1],
        "nees": normalised,
        "noise_scale": runs.noise_scale,
        "along_scan": (runs.along_scan_rms_mm > 0).any(-1),
        "along_scan_rms_mm": runs.along_scan_rms_mm.amax(-1),
        "iterations": runs.iterations,
        "converged": runs.converged,
        "prior_dominated": (widest >= OBSERVED_SHARE) & ~failed,
        "failed": failed,
    }
    return polars.DataFrame({name: values.numpy() for name, values in columns.items()})


def _bound(corners: ExactCorners, conditions: Conditions) -> Tensor:
    prior = torch.eye(3, dtype=corners.n.dtype) / conditions.prior_sigma**2
    return cramer_rao_bound(true_information(corners, conditions), prior)


def _means(of_point: polars.DataFrame, solved: polars.DataFrame) -> dict[str, float]:
    names = ["rmse_before_mm", "rmse_after_mm", "nees", "noise_scale", "along_scan", "along_scan_rms_mm"]
    names += ["converged", "prior_dominated"]
    used = polars.col("iterations").cast(polars.Float64).mean().alias("iterations_used")
    means = solved.select(polars.col(names).cast(polars.Float64).mean(), used).row(0, named=True)
    return {**means, "failed": float(of_point["failed"].to_numpy().mean())}


def _columns(prefix: str, values: Tensor) -> dict[str, Tensor]:
    return {f"{prefix}{k + 1}": column for k, column in enumerate(values.unbind(-1))}


def _by_component(prefix: str, values: Tensor) -> dict[str, float]:
    return {f"{prefix}_n{k + 1}": value for k, value in enumerate(values.tolist())}
