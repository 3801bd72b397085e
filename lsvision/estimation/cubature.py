"""Statistical linear regression by the cubature rule of degree 3: the one primitive of all filters here.

A function h of a Gaussian state x ~ N(m, L Lᵀ) is replaced by the affine model h(x) ≈ A x + b + r, r ~ N(0, Ω), that
loses least over the Gaussian. The 2n cubature points m ± √n L e_i come in pairs. What is odd in a pair gives A; what is
even in it gives b and a factor of Ω: no difference of covariances is ever formed.

Source: Arasaratnam & Haykin 2009, Eq. 31-32 (rule); García-Fernández et al. 2015, Eq. 9-11 (regression).
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.square_root import ordered_sum
from lsvision.estimation.triangular import apply

Function = Callable[[Tensor], Tensor]
"""Takes points ``(points, *batch, state)`` to values ``(points, *batch, measurement)``; parameters ``(*batch, ..)``."""


def slr(
    h: Function, mean: Float[Tensor, "*batch state"], chol: Float[Tensor, "*batch state state"]
) -> tuple[
    Float[Tensor, "*batch measurement state"],
    Float[Tensor, "*batch measurement"],
    Float[Tensor, "*batch measurement state"],
]:
    """Best affine model of h over a Gaussian: h(x) ≈ A x + b + r with r ~ N(0, Ω).

    Args:
        h: called once with points ``(2 state, *batch, state)``, returns ``(2 state, *batch, measurement)``.
        mean, chol: the Gaussian; ``chol`` lower triangular with a non-zero diagonal.

    Returns:
        A, b and a factor of Ω, ``factor @ factor.mT``; it is not triangular, and its rank is below ``state``.
    """
    center, odd, even = sigma_moments(h, mean.movedim(-1, 0), chol.movedim((-2, -1), (0, 1)))
    odd, even = (part.movedim((0, 1), (-2, -1)) for part in (odd, even))
    A = torch.linalg.solve_triangular(chol, odd, upper=False, left=False)
    return A, center.movedim(0, -1) - apply(A, mean), even


def sigma_moments(
    h: Function, mean: Float[Tensor, "state *batch"], factor: Float[Tensor, "state columns *batch"]
) -> tuple[
    Float[Tensor, "measurement *batch"],
    Float[Tensor, "measurement columns *batch"],
    Float[Tensor, "measurement columns *batch"],
]:
    """Mean of h, and its deviations split into what a line explains, A L, and the rest, a factor of Ω; batch last.

    Cov h = odd oddᵀ + even evenᵀ and Cov(x, h) = L oddᵀ. The factor may be any with L Lᵀ = P, of ``state`` columns.
    """
    columns = factor.shape[1]
    scale, pivot = math.sqrt(columns), mean[:, None]
    points = factor.new_empty(len(factor), 2 * columns, *factor.shape[2:])
    torch.add(pivot, factor, alpha=scale, out=points[:, :columns])
    torch.sub(pivot, factor, alpha=scale, out=points[:, columns:])
    values = h(points.movedim(0, -1)).movedim(-1, 0)
    plus, minus = values[:, :columns], values[:, columns:]
    middle = (plus + minus).div_(2)
    center = ordered_sum(middle) / columns
    return center[:, 0], (plus - minus).div_(2 * scale), (middle - center).div_(scale)
