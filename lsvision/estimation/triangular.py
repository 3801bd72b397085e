"""LAPACK's triangular factors, bit for bit the same for a matrix alone and for one of many.

LAPACK's last bits depend on how a matrix lies against the cache lines, and those of a matrix times a vector on whether
there is a batch. So dimensions are padded until all matrices of a batch lie alike, and products with vectors are sums.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

_LINE = 8  # float64 values of a cache line


def upper_root(matrix: Float[Tensor, "*batch rows columns"]) -> Float[Tensor, "*batch least columns"]:
    """R of the QR decomposition, Rᵀ R = matrixᵀ matrix, of as many rows as the smaller dimension; signs are free."""
    least, more = min(matrix.shape[-2:]), -matrix.shape[-2] % _LINE
    padded = pad(matrix, (0, 0, 0, more)) if more else matrix  # padding by nothing is a copy
    return torch.linalg.qr(padded, mode="r").R[..., :least, :]


def lower_factor(factor: Float[Tensor, "*batch state columns"]) -> Float[Tensor, "*batch state state"]:
    """Lower triangular L, diagonal not negative, with L Lᵀ = factor factorᵀ, of at least as many columns as rows."""
    lower = upper_root(factor.mT).mT
    return lower * torch.where(lower.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)[..., None, :]


def solve_upper(
    root: Float[Tensor, "*batch state state"], right: Float[Tensor, "*batch state columns"]
) -> Float[Tensor, "*batch state columns"]:
    """Solution of root x = right for an upper triangular root."""
    state = root.shape[-1]
    more = -state % _LINE
    padded = pad(root, (0, more, 0, more))
    padded.diagonal(dim1=-2, dim2=-1)[..., state:] = 1.0
    return torch.linalg.solve_triangular(padded, pad(right, (0, 0, 0, more)), upper=True)[..., :state, :]


def apply(
    matrix: Float[Tensor, "*#batch rows state"], vector: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch rows"]:
    """Matrix times vector."""
    return (matrix * vector[..., None, :]).sum(-1)
