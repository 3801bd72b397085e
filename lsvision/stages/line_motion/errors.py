"""How large the errors of registered lines are, and over how many lines they last: from what the registration leaves.

A line's registration sets the sum of a_u ψ_u over its columns u to zero, with a the rows of J / σ and ψ the weighted
residuals r / σ. These are errors of the matching, less what the three displacements took of them. Matching errs alike
over neighbouring columns and lines: with s_u the rms of ψ on a column and κ(l) the correlation of columns l apart,
R = s_u s_u' κ(u - u') is the covariance of ψ at the true displacement, and with d the mean derivative of ψ by r / σ

    displacements = G ψ,   G = (aᵀ d a)⁻¹ aᵀ,    cov = G R Gᵀ,    cov of the residuals = (1 - d a G) R (1 - d a G)ᵀ.

The last equation says how much the fit took; κ and s are raised until the residuals are as expected. Errors reach over
more columns of a flat crown than of a flank: each displacement has the κ of the columns that show it, weighted by G.
How long errors last shows in sums over pieces of neighbouring columns, as those carry what moves a line. What a
matching error has in common all over a line does not show in residuals and is stated beforehand.

Source: Huber 1981, ch. 7 (M-estimates); Newey & West 1987 (correlated errors); Bell & McCaffrey 2002 (residuals).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.line_motion.register import LOOSE_SIGMA, Equations

_LAGS = 100
_FORGOTTEN = 0.1  # correlation of lines below which the sum over the lags ends
_APART = 0.05  # correlation of columns that counts as none
_USUAL_MEMORY, _LEAST_MEMORY = 8.0, 0.3  # lines
_LEAST_LINES = 64  # needed to estimate the memory
_PIECE = 16  # columns in use that are summed for the memory
_ROUNDS = 5  # of raising the correlations by what the fit took
_LEAST_SCALE, _LEAST_SLOPE = 0.1, 0.1
_COMMON = 0.5  # of the lines: a column counts that takes part on so many


@dataclass(frozen=True)
class ErrorSums:
    """Sums over lines of products of ψ: of pairs of columns, and of pieces of columns some lines apart.

    ``sensitivity`` sums a, ``weight`` and ``slope`` the weights of residuals and the derivatives of ψ, by column. The
    numbers of terms stand beside the sums.
    """

    products: Float[Tensor, "columns columns"]
    pairs: Float[Tensor, "columns columns"]
    sensitivity: Float[Tensor, "columns 3"]
    weight: Float[Tensor, " columns"]
    slope: Float[Tensor, " columns"]
    lasting: Float[Tensor, "lags pieces"]
    lasting_pairs: Float[Tensor, "lags pieces"]

    @classmethod
    def of(cls, equations: Equations, cut_sigma: float) -> "ErrorSums":
        """Those of neighbouring lines; samples count as in the registration, not at all beyond ``cut_sigma``."""
        e = equations.residual / equations.sigma
        used = e.abs() < cut_sigma
        seen, share = used.to(e), (e / cut_sigma).square().masked_fill(~used, 1.0)
        weight, slope = (1 - share).square(), (1 - share) * (1 - 5 * share)  # of Tukey's ψ
        psi = e.masked_fill(~used, 0.0) * weight
        by_motion = [(by / equations.sigma).masked_fill(~used, 0.0).sum(0) for by in equations.by_motion]
        return cls(
            psi.T @ psi,
            seen.T @ seen,
            torch.stack(by_motion, -1),
            weight.sum(0),
            slope.sum(0),
            _lagged(_in_pieces(psi)),
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

        Raises:
            ValueError: no line shows the profile.
        """
        count = sums.pairs.diagonal()
        there = count > _COMMON * count.max()
        if not bool(there.any()):
            raise ValueError("no line shows the profile")
        per_line = (count[there, None]).clamp(min=1)
        a, weight = sums.sensitivity[there] / per_line, sums.weight[there, None] / per_line
        slope = (sums.slope[there, None] / per_line).clamp(min=_LEAST_SLOPE)
        loose = torch.diag(a.new_tensor(LOOSE_SIGMA) ** -2)  # of what nothing shows
        stated = torch.linalg.inv(a.T @ (weight * a) + loose)
        known = torch.linalg.inv(a.T @ (slope * a) + loose)
        G = known @ a.T
        products, pairs, taken = sums.products[there][:, there], sums.pairs[there][:, there], slope * a @ G
        R = torch.stack([_covariance(products, pairs, taken, row.abs()) for row in G])
        found = (G[:, None] @ R @ G[..., None])[:, 0, 0] + (known @ loose @ known).diagonal()
        variance = found.maximum(_LEAST_SCALE**2 * stated.diagonal())
        variance = variance + variance.new_tensor([0.0, common_mm**2, 0.0])
        share = torch.zeros_like(sums.sensitivity)
        share[there] = (G.square() * R.diagonal(dim1=-2, dim2=-1)).T
        return cls((variance / stated.diagonal()).sqrt(), _memory(sums, _in_pieces(share.T).T), variance.sqrt())


def _covariance(
    products: Tensor, pairs: Tensor, taken: Tensor, part: Float[Tensor, " columns"]
) -> Float[Tensor, "columns columns"]:
    """R from what the fit left, (1 - ``taken``) R (1 - ``taken``)ᵀ: ``products`` over ``pairs``.

    Args:
        part: of each column in what R is asked for, >= 0: the correlations are those of the columns that matter.
    """
    tiny = torch.finfo(products.dtype).tiny
    s = (products.diagonal() / pairs.diagonal()).sqrt().clamp(min=tiny)
    matter = part * part[:, None] / part.square().max().clamp(min=tiny)
    products, pairs = matter * products, matter * pairs
    weight = pairs * s * s[:, None]
    left = torch.eye(len(s)).to(s) - taken
    found = _by_lag(products) / _by_lag(weight).clamp(min=tiny)
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
