"""Triangular covariance factors by Householder reflections, the batch last and contiguous.

LAPACK takes matrices one by one. For thousands of small ones it is faster to run each reflection over all of them, the
batch being the innermost dimension; a single problem, without a batch dimension, is left to LAPACK. Sums run in one
order whatever the batch, so that no problem's result depends, in any bit, on how many others there are.

Source: Golub & Van Loan 2013, sec. 5.1-5.2; Bierman 1977, ch. IV.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def absorb(
    L: Float[Tensor, "size columns *batch"], *blocks: Float[Tensor, "_ extra *batch"]
) -> tuple[Float[Tensor, "rows columns *batch"], Float[Tensor, "rest kept *batch"]]:
    """Rotate E into L: L' L'ᵀ + E' E'ᵀ = L Lᵀ + E Eᵀ, where E' begins with as many zero rows as L has columns.

    Args:
        L: lower trapezoidal, diagonal not negative; rows of zeros follow where E has more rows.
        blocks: E in blocks of rows.

    Returns:
        L', lower trapezoidal with a diagonal that is not negative, and E' without its zero rows. NaN where a row of
        both is zero: the product is singular there.
    """
    return _absorb_one(L, blocks) if L.ndim == 2 else _absorb_batch(L, blocks)


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
    """Sum over columns from first to last: ``sum`` takes an order that depends on the size of the batch."""
    total = terms.new_zeros(len(terms), 1, *terms.shape[2:])
    return total.index_add_(1, torch.zeros(terms.shape[1], dtype=torch.long, device=terms.device), terms)


def _absorb_batch(L: Tensor, blocks: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    columns, rows = L.shape[1], sum(map(len, blocks))
    out = torch.cat([L, L.new_zeros(rows - len(L), *L.shape[1:])])
    rest = L.new_empty(rows, blocks[0].shape[1] + 1, *L.shape[2:])  # its first column is the one of L being worked on
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


def _absorb_one(L: Tensor, blocks: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    E, columns = torch.cat(blocks), L.shape[1]
    padded = torch.nn.functional.pad(L, (0, 0, 0, len(E) - len(L)))
    lower = torch.linalg.qr(torch.cat([padded, E], dim=1).mT, mode="r").R.mT
    diagonal = lower.diagonal()
    lower = lower * torch.where(diagonal < 0, -1.0, 1.0)
    return torch.where(diagonal[:columns] != 0, lower[:, :columns], torch.nan), lower[columns:, columns:]
