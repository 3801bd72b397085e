"""What the two processes that share a signal consist of: broad parts, and waves that wander over a coherence length."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import exponential, matern32
from lsvision.estimation.state_space_process import Process, matern, oscillation

_NOTHING = 1e-4  # of a usual sigma: a process that is not there


@dataclass(frozen=True)
class Part:
    """One part of the processes a and b.

    Attributes:
        sigma: of a and of b, > 0.
        span: lengths of a and of b of a broad part; period and coherence of a wave; samples.
    """

    kind: Literal["broad", "wave"]
    sigma: Float[Tensor, "*batch 2"]
    span: Float[Tensor, "*batch 2"]

    def moved(self, logarithms: Float[Tensor, "candidates 4"]) -> "Part":
        """Candidates, by the logarithms of the factors on all four numbers."""
        sigma, span = logarithms.exp().split(2, -1)
        return replace(self, sigma=self.sigma * sigma, span=self.span * span)

    def only(self, kept: tuple[bool, bool]) -> "Part":
        """The part of a alone, or of b alone."""
        there = self.sigma.new_tensor([1.0 if part else _NOTHING for part in kept])
        return replace(self, sigma=self.sigma * there)

    def at(self, index: int) -> "Part":
        """One of several candidates."""
        return replace(self, sigma=self.sigma[index], span=self.span[index])

    def process(self, which: int) -> Process:
        """Of a (0) or b (1), in state-space form."""
        if self.kind == "broad":
            return matern(2, self.sigma[which], self.span[which])
        return oscillation(self.sigma[which], self.span[0], self.span[1])

    def covariance(self, lag: Float[Tensor, " lags"], process: int) -> Float[Tensor, "*batch lags"]:
        """Of a (0) or b (1)."""
        variance = self.sigma[..., process, None].square()
        if self.kind == "broad":
            return variance * matern32(lag / self.span[..., process, None])
        period, coherence = self.span[..., :1], self.span[..., 1:]
        return variance * torch.cos(2 * math.pi / period * lag) * exponential(lag / coherence)
