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

Function = Callable[[Tensor], Tensor]
"""Takes points ``(points, *batch, state)`` to values ``(points, *batch, measurement)``; parameters lead by ``*batch``."""


def cubature_points(
    mean: Float[Tensor, "*batch state"], chol: Float[Tensor, "*batch state state"]
) -> Float[Tensor, "points *batch state"]:
    """The 2n equally weighted points of N(mean, chol cholᵀ): first all m + √n L e_i, then all m - √n L e_i."""
    offsets = math.sqrt(mean.shape[-1]) * chol.movedim(-1, 0)
    return torch.cat([mean + offsets, mean - offsets])


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
    center, odd, even = sigma_moments(h, mean, chol)
    A = torch.linalg.solve_triangular(chol, odd, upper=False, left=False)
    return A, center - (A @ mean[..., None])[..., 0], even


def sigma_moments(
    h: Function, mean: Float[Tensor, "*batch state"], chol: Float[Tensor, "*batch state columns"]
) -> tuple[
    Float[Tensor, "*batch measurement"],
    Float[Tensor, "*batch measurement columns"],
    Float[Tensor, "*batch measurement columns"],
]:
    """Mean of h, and its deviations split into what a line explains, A L, and the rest, a factor of Ω.

    Cov h = odd oddᵀ + even evenᵀ and Cov(x, h) = L oddᵀ.
    """
    plus, minus = h(cubature_points(mean, chol)).chunk(2)
    middle = (plus + minus) / 2
    center = middle.mean(0)
    scale = math.sqrt(chol.shape[-1])
    odd, even = (plus - minus) / (2 * scale), (middle - center) / scale
    return center, odd.movedim(0, -1), even.movedim(0, -1)
