"""Fisher information, Cramér-Rao bound, and the directions of a posterior against its prior.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, sec. 2.7.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.derivative import jacobian


def fisher_information(
    whitened_residual: Callable[[Tensor], Tensor], state: Float[Tensor, " state"]
) -> Float[Tensor, "state state"]:
    """Library API: information Jᵀ J of measurements on a state, J by forward differentiation.

    Args:
        whitened_residual: takes ``(state,)`` to measured less predicted values in sigmas, any shape. A prior has no
            part in it.
    """
    J = jacobian(whitened_residual, state).flatten(0, -2)
    return J.mT @ J


def marginal_information(
    information: Float[Tensor, "*batch state state"], keep: int
) -> Float[Tensor, "*batch keep keep"]:
    """Library API: information on the last ``keep`` components, all others unknown, the Schur complement.

    Raises:
        torch.linalg.LinAlgError: the others are not determined even where the last are known.
    """
    nuisance, cross = information[..., :-keep, :-keep], information[..., :-keep, -keep:]
    return information[..., -keep:, -keep:] - cross.mT @ torch.linalg.solve(nuisance, cross)


def cramer_rao_bound(
    information: Float[Tensor, "*batch state state"], prior_information: Float[Tensor, "*#batch state state"]
) -> Float[Tensor, "*batch state state"]:
    """Smallest covariance that an unbiased estimator can have, given the measurements' and the prior's information."""
    total = information + prior_information
    scale = total.diagonal(dim1=-2, dim2=-1).rsqrt()  # mm beside radians: equilibrate before inverting
    balanced = scale[..., :, None] * total * scale[..., None, :]
    return scale[..., :, None] * torch.linalg.inv(balanced) * scale[..., None, :]


@dataclass(frozen=True)
class Directions:
    """Directions in which a posterior is independent, the weakest first.

    ``vectors`` are unit vectors as rows, their largest component positive; ``share`` is the posterior sigma over the
    prior's along each, 1 where the data contribute nothing.
    """

    vectors: Float[Tensor, "*batch state state"]
    share: Float[Tensor, "*batch state"]

    @property
    def weakest(self) -> Float[Tensor, "*batch state"]:
        """The direction that the data determine least."""
        return self.vectors[..., 0, :]


def principal_directions(covariance: Float[Tensor, "*batch state state"], prior_sigma: float) -> Directions:
    """The principal axes of a posterior in units of an isotropic prior, the widest first."""
    variance, columns = torch.linalg.eigh(covariance)
    vectors = columns.mT.flip(-2)
    largest = vectors.gather(-1, vectors.abs().argmax(-1, keepdim=True))
    return Directions(vectors * largest.sign(), variance.flip(-1).clamp(min=0.0).sqrt() / prior_sigma)
