"""How large the errors of registered lines are, and over how many lines they last: from what the registration leaves.

The residuals e = r / σ of a line on its columns u are errors of the matching, less what the three displacements took
of them. Matching errs alike over neighbouring columns and lines: with s_u the rms of a column and κ(l) the correlation
of columns l apart, R = s_u s_u' κ(u - u') is the covariance of the errors, and with the rows a of J / σ

    displacements = G e,   G = (aᵀ a)⁻¹ aᵀ,        cov = G R Gᵀ,        cov of the residuals = (1 - a G) R (1 - a G)ᵀ.

The last equation says how much the fit took; κ and s are raised until the residuals are as expected. How long errors
last shows in sums over pieces of neighbouring columns, as those carry what moves a line. What a matching error has in
common all over a line does not show in residuals and is stated beforehand.

Source: Newey & West 1987 (covariance of correlated errors); Bell & McCaffrey 2002 (what the fit takes of residuals).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.line_motion.register import Equations

_LAGS = 100
_FORGOTTEN = 0.1  # correlation of lines below which the sum over the lags ends
_APART = 0.05  # correlation of columns that counts as none
_USUAL_MEMORY, _LEAST_MEMORY = 8.0, 0.3  # lines
_LEAST_LINES = 64  # needed to estimate the memory
_PIECE = 16  # columns in use that are summed for the memory
_ROUNDS = 5  # of raising the correlations by what the fit took
_LEAST_SCALE = 0.1
_COMMON = 0.5  # of the lines: a column counts that takes part on so many


@dataclass(frozen=True)
class ErrorSums:
    """Sums over lines of products of residuals e: of pairs of columns, and of pieces of columns some lines apart.

    ``sensitivity`` sums a = J / σ. The numbers of terms stand beside the sums.
    """

    products: Float[Tensor, "columns columns"]
    pairs: Float[Tensor, "columns columns"]
    sensitivity: Float[Tensor, "columns 3"]
    lasting: Float[Tensor, "lags pieces"]
    lasting_pairs: Float[Tensor, "lags pieces"]

    @classmethod
    def of(cls, equations: Equations, cut_sigma: float) -> "ErrorSums":
        """Those of neighbouring lines; samples beyond ``cut_sigma`` do not count."""
        e = equations.residual / equations.sigma
        used = e.abs() < cut_sigma
        e, seen = e.masked_fill(~used, 0.0), used.to(e)
        by_motion = [(by / equations.sigma).masked_fill(~used, 0.0).sum(0) for by in equations.by_motion]
        return cls(
            e.T @ e,
            seen.T @ seen,
            torch.stack(by_motion, -1),
            _lagged(_in_pieces(e)),
            _lagged(_in_pieces(seen) / _PIECE),
        )

    @classmethod
    def total(cls, parts: Sequence["ErrorSums"]) -> "ErrorSums":
        """Of several ranges of lines."""
        return cls(*(torch.stack([getattr(part, each.name) for part in parts]).sum(0) for each in fields(cls)))


@dataclass(frozen=True)
class LineErrors:
    """Errors of (δx, δz, ρ) of a line.

    ``scale`` is their true size over that of independent samples, ``memory`` the lines over which they are forgotten,
    ``rms`` their size on a line that shows all of the object, mm and rad.
    """

    scale: Float[Tensor, "3"]
    memory: Float[Tensor, "3"]
    rms: Float[Tensor, "3"]

    @classmethod
    def of(cls, sums: ErrorSums, common_mm: float) -> "LineErrors":
        """Errors of lines whose residuals were summed.

        Args:
            common_mm: what the depths of a line err by all together.
        """
        count = sums.pairs.diagonal()
        there = count > _COMMON * count.max()
        a = (sums.sensitivity / count.clamp(min=1)[:, None])[there]
        stated = torch.linalg.inv(a.T @ a)
        G = stated @ a.T
        R = _covariance(sums.products[there][:, there], sums.pairs[there][:, there], a @ G)
        variance = (G @ R @ G.T).diagonal().maximum(_LEAST_SCALE**2 * stated.diagonal())
        variance = variance + variance.new_tensor([0.0, common_mm**2, 0.0])
        weight = torch.zeros_like(sums.sensitivity)
        weight[there] = (G.square() * R.diagonal()).T
        return cls((variance / stated.diagonal()).sqrt(), _memory(sums, _in_pieces(weight.T).T), variance.sqrt())


def _covariance(products: Tensor, pairs: Tensor, taken: Tensor) -> Float[Tensor, "columns columns"]:
    """R from what the fit left, (1 - ``taken``) R (1 - ``taken``)ᵀ: ``products`` over ``pairs``."""
    s = (products.diagonal() / pairs.diagonal()).sqrt().clamp(min=torch.finfo(products.dtype).tiny)
    weight = pairs * s * s[:, None]
    left = torch.eye(len(s)).to(s) - taken
    found = _by_lag(products) / _by_lag(weight).clamp(min=torch.finfo(s.dtype).tiny)
    kappa = found
    lag = (torch.arange(len(s))[:, None] - torch.arange(len(s))).abs()
    for _ in range(_ROUNDS):
        R = (kappa * ((kappa > _APART * kappa[0]).cumprod(0)))[lag] * s * s[:, None]
        expected = left @ R @ left.T
        kappa = found + (_by_lag(pairs * R) - _by_lag(pairs * expected)) / _by_lag(weight).clamp(min=1e-300)
    return R


def _by_lag(matrix: Float[Tensor, "columns columns"]) -> Float[Tensor, " columns"]:
    """Sums along the diagonals, from the main one on."""
    return torch.stack([matrix.diagonal(lag).sum() for lag in range(len(matrix))])


def _in_pieces(values: Float[Tensor, "lines columns"]) -> Float[Tensor, "lines pieces"]:
    """Sums over pieces of neighbouring columns."""
    return torch.stack([piece.sum(1) for piece in values.split(_PIECE, dim=1)], dim=1)


def _lagged(series: Float[Tensor, "lines pieces"]) -> Float[Tensor, "lags pieces"]:
    """Sums of products of lines some lags apart."""
    power = torch.fft.rfft(series, n=2 * len(series), dim=0).abs().square()
    sums = torch.fft.irfft(power, dim=0)[: min(_LAGS, len(series))]
    return torch.cat([sums, sums.new_zeros(_LAGS - len(sums), sums.shape[1])])


def _memory(sums: ErrorSums, weight: Float[Tensor, "pieces 3"]) -> Float[Tensor, "3"]:
    """Memory of errors that forget exponentially and have the same sum of correlations over all lags.

    Args:
        weight: of every piece in the error of each displacement.
    """
    enough = sums.lasting_pairs >= sums.lasting_pairs[0] / 2
    usual = torch.full_like(weight[0], _USUAL_MEMORY)
    if float(sums.pairs.max()) < _LEAST_LINES:
        return usual
    mean = torch.where(enough, sums.lasting / sums.lasting_pairs.clamp(min=1), 0.0) @ weight
    correlation = mean / mean[0].clamp(min=torch.finfo(mean.dtype).tiny)
    lasting = (correlation > _FORGOTTEN).cumprod(0)
    total = 2 * (correlation * lasting).sum(0) - 1
    kept = ((total - 1) / (total + 1)).clamp(min=torch.finfo(total.dtype).tiny)
    return (-1 / kept.log()).clamp(min=_LEAST_MEMORY)
