"""Random Gaussians and measurement models that the filters are checked on."""

import torch
from torch import Tensor

from lsvision.estimation import apply
from lsvision.geometry import rotation_from_vector, scan_position

STATE = torch.tensor([0.1, -0.2, 0.15, 20.0, 60.0, 800.0, 0.03, 1.02, 0.02], dtype=torch.float64)


def random(*shape: int) -> Tensor:
    """Normal numbers, float64."""
    return torch.randn(*shape, dtype=torch.float64)


def random_covariance(*shape: int) -> Tensor:
    """Full, well-conditioned covariance matrices ``(*shape, shape[-1])``."""
    factor = random(*shape, shape[-1])
    return factor @ factor.mT + 0.1 * torch.eye(shape[-1], dtype=torch.float64)


def corner(states: Tensor, point: tuple[float, float] = (120.0, 80.0)) -> Tensor:
    """Measured (x, y, z) of one board corner from the state [theta, t, n]."""
    moved = rotation_from_vector(states[..., :3]) @ states.new_tensor([*point, 0.0]) + states[..., 3:6]
    return scan_position(moved, states[..., 6:])


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix times vector, with the same bits for one as for many."""
    return apply(matrix, vector)
