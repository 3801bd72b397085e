"""Statistical linear regression by the cubature rule of degree 3: the one primitive of all filters here.

A function h of a Gaussian state x ~ N(m, L Lᵀ) is replaced by the affine model h(x) ≈ A x + b + r, r ~ N(0, Ω), that
fits best over the Gaussian. The 2n cubature points m ± √n L e_i come in pairs. The odd part of the values at a pair
gives A; their even part gives b and a factor of Ω: no difference of covariances is ever formed.

Source: Arasaratnam & Haykin 2009, Eq. 31-32 (rule); García-Fernández et al. 2015, Eq. 9-11 (regression).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.linalg import apply, ordered_sum

Function = Callable[[Tensor], Tensor]
"""Takes points ``(points, *batch, state)`` to values ``(points, *batch, measurement)``; parameters ``(*batch, ..)``."""


@dataclass(frozen=True)
class AffineModel:
    """h(x) ≈ A x + b + r with r ~ N(0, Ω), Ω = error errorᵀ.

    ``error`` is not triangular, and its rank is below ``state``.
    """

    A: Float[Tensor, "*batch measurement state"]
    b: Float[Tensor, "*batch measurement"]
    error: Float[Tensor, "*batch measurement state"]

    def at(self, x: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch measurement"]:
        """A x + b."""
        return apply(self.A, x) + self.b


@dataclass(frozen=True)
class SigmaMoments:
    """Moments of h over a Gaussian with factor L, the batch last: Cov h = odd oddᵀ + even evenᵀ, Cov(x, h) = L oddᵀ.

    ``center`` is the mean of h, ``odd`` is A L, the part of Cov h that a line explains, and ``even`` the rest, a factor
    of Ω.
    """

    center: Float[Tensor, "measurement *batch"]
    odd: Float[Tensor, "measurement columns *batch"]
    even: Float[Tensor, "measurement columns *batch"]

    @property
    def factor(self) -> Float[Tensor, "measurement twice *batch"]:
        """Factor of Cov h."""
        return torch.cat([self.odd, self.even], dim=1)


def slr(h: Function, mean: Float[Tensor, "*batch state"], chol: Float[Tensor, "*batch state state"]) -> AffineModel:
    """Best affine model of h over a Gaussian.

    Args:
        h: called once with points ``(2 state, *batch, state)``, returns ``(2 state, *batch, measurement)``.
        mean, chol: the Gaussian; ``chol`` lower triangular with a non-zero diagonal.
    """
    moments = sigma_moments(h, mean.movedim(-1, 0), chol.movedim((-2, -1), (0, 1)))
    odd, even = (part.movedim((0, 1), (-2, -1)) for part in (moments.odd, moments.even))
    A = torch.linalg.solve_triangular(chol, odd, upper=False, left=False)
    return AffineModel(A, moments.center.movedim(0, -1) - apply(A, mean), even)


def sigma_moments(
    h: Function, mean: Float[Tensor, "state *batch"], factor: Float[Tensor, "state columns *batch"]
) -> SigmaMoments:
    """Moments of h at the cubature points; the factor may be any with L Lᵀ = P, of ``state`` columns."""
    columns = factor.shape[1]
    scale, pivot = math.sqrt(columns), mean[:, None]
    points = factor.new_empty(len(factor), 2 * columns, *factor.shape[2:])
    torch.add(pivot, factor, alpha=scale, out=points[:, :columns])
    torch.sub(pivot, factor, alpha=scale, out=points[:, columns:])
    values = h(points.movedim(0, -1)).movedim(-1, 0)
    plus, minus = values[:, :columns], values[:, columns:]
    middle = (plus + minus).div_(2)
    center = ordered_sum(middle) / columns
    return SigmaMoments(center[:, 0], (plus - minus).div_(2 * scale), (middle - center).div_(scale))
