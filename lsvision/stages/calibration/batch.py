"""The result of calibrating a batch of problems."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.stages.calibration.along_scan import COMPONENTS
from lsvision.types import ErrorAlongScan, Iteration

# Errors along the scan below this part of the largest are not mentioned, though allowed for.
_FAINT = 0.1


@dataclass(frozen=True)
class BatchCalibration:
    """Calibrations of a batch of problems; a problem whose ``info`` is SINGULAR holds NaN.

    ``noise_scale`` is the factor on the given covariance that the residuals asked for, 1 where they are as expected;
    ``along_scan_rms_mm`` and ``along_scan_length_mm`` are of the errors in x, travel, z and roll that are correlated
    along the scan, zero where none were found. Covariances include both, but need not cover errors that are
    ``along_scan_unlike`` those that were modelled. ``rmse_path_mm`` and ``n_path`` run by iteration from the state
    before (index 0), and repeat the result past a problem's last iteration.
    """

    n: Float[Tensor, "*batch 3"]
    covariance: Float[Tensor, "*batch 3 3"]
    rotation: Float[Tensor, "*batch boards 3 3"]
    translation_mm: Float[Tensor, "*batch boards 3"]
    rmse_path_mm: Float[Tensor, "iterations *batch"]
    n_path: Float[Tensor, "iterations *batch 3"]
    board_rmse_before_mm: Float[Tensor, "*batch boards"]
    board_rmse_after_mm: Float[Tensor, "*batch boards"]
    noise_scale: Float[Tensor, "*batch"]
    along_scan_rms_mm: Float[Tensor, "*batch 4"]
    along_scan_length_mm: Float[Tensor, "*batch 4"]
    along_scan_unlike: Bool[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    converged: Bool[Tensor, "*batch"]
    info: Int[Tensor, "*batch"]

    def as_batch_of_one(self) -> "BatchCalibration":
        """One problem's calibration with a leading batch dimension of one."""
        by_iteration = ("rmse_path_mm", "n_path")
        return BatchCalibration(
            **{item.name: getattr(self, item.name).unsqueeze(int(item.name in by_iteration)) for item in fields(self)}
        )


def iterations_of(batch: BatchCalibration) -> tuple[Iteration, ...]:
    """The iterations of one problem."""
    stretch = torch.linalg.vector_norm(batch.n_path, dim=-1)
    return tuple(
        Iteration(rmse_mm, (n1, n2, n3), length)
        for rmse_mm, (n1, n2, n3), length in zip(
            batch.rmse_path_mm.tolist(), batch.n_path.tolist(), stretch.tolist(), strict=True
        )
    )


def errors_along_scan_of(batch: BatchCalibration) -> tuple[ErrorAlongScan, ...]:
    """Those of one problem that are not much smaller than the largest."""
    return named_errors(batch.along_scan_rms_mm, batch.along_scan_length_mm)


def named_errors(rms_mm: Float[Tensor, "4"], length_mm: Float[Tensor, "4"]) -> tuple[ErrorAlongScan, ...]:
    """Errors by component, those that are not much smaller than the largest."""
    rms, length = rms_mm.tolist(), length_mm.tolist()
    return tuple(
        ErrorAlongScan(*error) for error in zip(COMPONENTS, rms, length, strict=True) if error[1] > _FAINT * max(rms)
    )
