"""Linear algebra of many small matrices: a problem gives the same bits alone and as one of many.

The rule: no bit of a problem's result depends on how many other problems are in the batch, or on where it lies among
them. torch and LAPACK break it in three ways, and the functions here, which the rest of the library calls in their
place, avoid them:

- the last bits of LAPACK's factors depend on how a matrix lies against the cache lines: ``upper_root``,
  ``lower_factor`` and ``solve_upper`` pad the dimensions until all matrices of a batch lie alike;
- a matrix product takes another kernel for a batch than for one matrix: ``apply`` and ``product`` are sums of
  products of elements;
- ``sum`` over a dimension before the batch takes an order that depends on the size of the batch: ``ordered_sum`` adds
  from first to last.

Matrices stand in the last two dimensions. In ``absorb``, ``forward_substitute`` and ``ordered_sum`` the batch is last
and contiguous instead: for thousands of small matrices it is faster to run each reflection over all of them than to
call LAPACK for one after the other. These three use LAPACK for a problem without any batch dimension, which agrees with
the same problem in a batch to rounding only.

Source: Golub & Van Loan 2013, sec. 5.1-5.2; Bierman 1977, ch. IV.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

_LINE = 8  # float64 values of a cache line


def apply(
    matrix: Float[Tensor, "*#batch rows state"], vector: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch rows"]:
    """Matrix times vector."""
    return (matrix * vector[..., None, :]).sum(-1)


def product(
    left: Float[Tensor, "*#batch rows inner"], right: Float[Tensor, "*#batch inner columns"]
) -> Float[Tensor, "*batch rows columns"]:
    """Matrix times matrix.

    By outer products, added one after the other: for batches five times as fast as a sum over all products at once,
    which do not stay near the processor.
    """
    total = left[..., :1] * right[..., :1, :]
    for k in range(1, left.shape[-1]):
        total = total + left[..., k : k + 1] * right[..., k : k + 1, :]
    return total


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


def absorb(
    L: Float[Tensor, "size columns *batch"], *blocks: Float[Tensor, "_ extra *batch"]
) -> tuple[Float[Tensor, "rows columns *batch"], Float[Tensor, "rest kept *batch"]]:
    """Rotate E into L: L' L'ᵀ + E' E'ᵀ = L Lᵀ + E Eᵀ, where E' begins with as many zero rows as L has columns.

    Args:
        L: lower trapezoidal, diagonal not negative; rows of zeros follow where E has more rows.
        blocks: E in blocks of rows.

    Returns:
        L', lower trapezoidal with a diagonal that is not negative, and E' without its zero rows. NaN where a row of
        both is zero: the sum is singular then.
    """
    return _absorb_by_qr(L, blocks) if L.ndim == 2 else _absorb_by_reflections(L, blocks)


def forward_substitute(
    L: Float[Tensor, "rows rows *batch"], right: Float[Tensor, "rows columns *batch"]
) -> Float[Tensor, "rows columns *batch"]:
    """Solution of L x = right for a lower triangular L."""
    if L.ndim == 2:
        return torch.linalg.solve_triangular(L, right, upper=False)
    solution: list[Tensor] = []
    for k in range(len(right)):
        rest = right[k]
        for j, known in enumerate(solution):
            rest = rest - L[k, j] * known
        solution.append(rest / L[k, k])
    return torch.stack(solution)


def ordered_sum(terms: Float[Tensor, "rows columns *batch"]) -> Float[Tensor, "rows 1 *batch"]:
    """Sum over columns from first to last."""
    total = terms.new_zeros(len(terms), 1, *terms.shape[2:])
    return total.index_add_(1, torch.zeros(terms.shape[1], dtype=torch.long, device=terms.device), terms)


def batch_last(tensor: Tensor, dims: int) -> Tensor:
    """Moves the last ``dims`` dimensions before the batch, contiguous."""
    return tensor.movedim(tuple(range(-dims, 0)), tuple(range(dims))).contiguous()


def batch_first(tensor: Tensor, dims: int) -> Tensor:
    """Moves the first ``dims`` dimensions behind the batch: the inverse of ``batch_last``."""
    return tensor.movedim(tuple(range(dims)), tuple(range(-dims, 0)))


def _absorb_by_reflections(L: Tensor, blocks: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """One Householder reflection per column of L, each over the whole batch at once."""
    columns, rows = L.shape[1], sum(map(len, blocks))
    out = torch.cat([L, L.new_zeros(rows - len(L), *L.shape[1:])])
    rest = L.new_empty(rows, blocks[0].shape[1] + 1, *L.shape[2:])  # its first column is the column of L in work
    products = torch.empty_like(rest)
    for block, part in zip(blocks, rest[:, 1:].split([len(block) for block in blocks]), strict=True):
        part.copy_(block)
    for k in range(columns):
        below, slot, row = out[k:, k : k + 1], rest[:, :1], rest[0]
        slot.copy_(below)
        column = ordered_sum(torch.mul(rest, row, out=products[k:]))
        norm = column[:1].sqrt()
        below.copy_(column.div_(norm))
        share = column.add_(slot).div_(norm.add_(row[:1]))  # of the row, that each row below loses
        rest = rest[1:].addcmul_(row, share[1:], value=-1)
    return out, rest[:, 1:]


def _absorb_by_qr(L: Tensor, blocks: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """The same by LAPACK, for one problem."""
    E, columns = torch.cat(blocks), L.shape[1]
    padded = pad(L, (0, 0, 0, len(E) - len(L)))
    lower = torch.linalg.qr(torch.cat([padded, E], dim=1).mT, mode="r").R.mT
    diagonal = lower.diagonal()
    lower = lower * torch.where(diagonal < 0, -1.0, 1.0)
    return torch.where(diagonal[:columns] != 0, lower[:, :columns], torch.nan), lower[columns:, columns:]
