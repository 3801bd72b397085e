"""Gaussian processes along evenly spaced samples as Markov processes: x' = F x + q, f = x_0.

Filter and smoother then cost as much as there are samples.

The state holds f and its derivatives in units of the process's own rate, x = (f, f'/λ, f''/λ², ..), so that it is well
scaled at any spacing. A process of smoothness 1/2 and a length much longer than the data is a random walk, one of 3/2
an integrated random walk.

Source: Hartikainen & Särkkä 2010; Särkkä & Solin 2019, Applied Stochastic Differential Equations, ch. 12.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.linalg import lower_factor

# States of the Matérn processes of smoothness 1/2, 3/2 and 5/2: stationary covariance, and power of the white noise
# that drives the last derivative, for variance and rate one.
_STATIONARY: dict[int, list[list[float]]] = {
    1: [[1.0]],
    2: [[1.0, 0.0], [0.0, 1.0]],
    3: [[1.0, 0.0, -1 / 3], [0.0, 1 / 3, 0.0], [-1 / 3, 0.0, 1.0]],
}
_POWER = {1: 2.0, 2: 4.0, 3: 16 / 3}
_NODES = 24  # of the quadrature over one step
_FORGOTTEN = 30.0  # rates after which nothing is left of a state


@dataclass(frozen=True)
class Process:
    """A stationary Markov process whose value is the first component of its state.

    Attributes:
        transition: F. noise_root: lower triangular root of the covariance of q.
        start_root: lower triangular root of the stationary covariance.
    """

    transition: Float[Tensor, "*batch state state"]
    noise_root: Float[Tensor, "*batch state state"]
    start_root: Float[Tensor, "*batch state state"]

    @property
    def size(self) -> int:
        """Number of states."""
        return self.transition.shape[-1]


def matern(states: int, sigma: Float[Tensor, "*batch"], length: Float[Tensor, "*batch"]) -> Process:
    """Matérn process of smoothness ``states`` - 1/2.

    Args:
        states: 1, 2 or 3. sigma: standard deviation of f, > 0.
        length: of the kernel, in samples, > 0.
    """
    rate = math.sqrt(2 * states - 1) / length
    nodes, weights = (torch.from_numpy(part).to(rate) for part in np.polynomial.legendre.leggauss(_NODES))
    span = rate.clamp(max=_FORGOTTEN)[..., None]
    # Columns √weight exp(A s) e_last: a root of the integral over the step, without a difference of covariances.
    driven = _exponential(states, span * (nodes + 1) / 2)[..., -1]
    columns = (driven * (_POWER[states] * span * weights / 2).sqrt()[..., None]).mT
    stationary = torch.linalg.cholesky(torch.tensor(_STATIONARY[states], dtype=rate.dtype, device=rate.device))
    scale = sigma[..., None, None]
    return Process(
        _exponential(states, rate), scale * lower_factor(columns), (scale * stationary).expand(*rate.shape, -1, -1)
    )


def oscillation(
    sigma: Float[Tensor, "*batch"], period: Float[Tensor, "*batch"], coherence: Float[Tensor, "*batch"]
) -> Process:
    """A wave whose amplitude and phase wander: a resonance.

    Args:
        sigma: standard deviation of f, > 0. period: samples of one wave. coherence: samples after which it is another.
    """
    angle, decay = 2 * math.pi / period, torch.exp(-1 / coherence)
    cos, sin = decay * torch.cos(angle), decay * torch.sin(angle)
    turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)
    eye = torch.eye(2, dtype=decay.dtype, device=decay.device)
    fresh = (-torch.expm1(-2 / coherence)).sqrt()
    return Process(turn, (sigma * fresh)[..., None, None] * eye, (sigma[..., None, None] * eye).expand_as(turn))


def _exponential(states: int, time: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch state state"]:
    """exp(A s) of the companion matrix A of (1 + d/ds)^states: A + 1 is nilpotent, the series ends."""
    # Row i of A + 1 takes x_i to x_i + x_i+1; the last one holds minus the binomials.
    companion = (
        torch.diag_embed(torch.ones(states - 1, dtype=time.dtype, device=time.device), 1) if states > 1 else None
    )
    A = time.new_zeros(states, states) if companion is None else companion
    A[-1] = -time.new_tensor([math.comb(states, i) for i in range(states)])
    nilpotent = A + torch.eye(states, dtype=time.dtype, device=time.device)
    powers = [torch.linalg.matrix_power(nilpotent, k) / math.factorial(k) for k in range(states)]
    series = torch.stack([time**k for k in range(states)], -1)[..., None, None] * torch.stack(powers)
    return torch.exp(-time)[..., None, None] * series.sum(-3)
