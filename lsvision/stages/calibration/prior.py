"""The prior of a calibration on n and on the poses of the boards."""

import torch
from jaxtyping import Float

from lsvision.estimation import Prior
from lsvision.stages.calibration.config import CalibrationConfig


def prior_about(start: Float[torch.Tensor, "*batch state"], config: CalibrationConfig) -> Prior:
    """The configured prior on n and on the poses about the start; its root is diagonal, zero where it is flat."""
    boards = (start.shape[-1] - 3) // 6
    pose = [1 / config.rotation_sigma_rad] * 3 + [1 / config.translation_sigma_mm] * 3
    diagonal = start.new_tensor(pose * boards + [1 / config.prior_sigma] * 3)
    return Prior(start, torch.diag(diagonal).expand(*start.shape, start.shape[-1]))
