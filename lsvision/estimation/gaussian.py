"""Gaussians by mean and covariance factor, and priors by mean and information root."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.linalg import apply, batch_first, batch_last, product

NORMAL_OVER_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@dataclass(frozen=True)
class Gaussian:
    """N(mean, P) with P = factor factorᵀ.

    The factor may be any with that product, unless a function asks for a Cholesky factor: lower triangular, its
    diagonal positive.
    """

    mean: Float[Tensor, "*batch state"]
    factor: Float[Tensor, "*batch state columns"]

    @property
    def covariance(self) -> Float[Tensor, "*batch state state"]:
        """P."""
        return product(self.factor, self.factor.mT)


@dataclass(frozen=True)
class Prior:
    """Knowledge of a state before any measurement: twice the negative log density is ‖root (x - mean)‖² + constant.

    The root may be singular: rows of zeros make a flat prior.
    """

    mean: Float[Tensor, "*batch state"]
    root: Float[Tensor, "*#batch rows state"]

    def residual(self, x: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch rows"]:
        """Distance of a state from the mean in sigmas, root (x - mean)."""
        return apply(self.root, x - self.mean)


@dataclass(frozen=True)
class BatchLast:
    """A Gaussian as the filters' kernels take it: the batch last and contiguous."""

    mean: Float[Tensor, "state *batch"]
    factor: Float[Tensor, "state columns *batch"]

    @classmethod
    def of(cls, gaussian: Gaussian) -> "BatchLast":
        """The same Gaussian, the batch moved behind."""
        return cls(batch_last(gaussian.mean, 1), batch_last(gaussian.factor, 2))

    def gaussian(self) -> Gaussian:
        """The same Gaussian, the batch in front."""
        return Gaussian(batch_first(self.mean, 1), batch_first(self.factor, 2))
