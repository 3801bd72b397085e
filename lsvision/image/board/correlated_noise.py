"""How much larger the variance of a fit is because the residuals of neighbouring pixels are correlated."""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

_CELLS = 8  # across a window
_SHORT, _LONG = 2, 4  # cells across a block: a quarter and half of a window


def correlation_gain(
    jacobian: Float[Tensor, "fits parameters pixels"],
    inverse_normal: Float[Tensor, "fits parameters parameters"],
    wanted: slice,
    residual: Float[Tensor, "fits pixels"],
    variance: Float[Tensor, " fits"],
) -> Float[Tensor, " fits"]:
    """Variance of the wanted parameters of least-squares fits, over the variance that independent noise would give.

    The sandwich estimator: sums of ``influence x residual`` over overlapping blocks of pixels, squared and added, are
    the variance under noise that is correlated within a block. Each is divided by the expectation of the same sums when
    the noise is independent and the fit has reduced it, so that the gain is 1 there, whatever the window. Pixels at
    opposite ends of a block share fewer blocks than neighbours; twice the long blocks' gain less the short ones' makes
    up for that.

    Args:
        jacobian: derivative of square windows, ``pixels = size²``, by the parameters; 0 at pixels that are not fitted.
        inverse_normal: inverse of ``J Jᵀ``.
        wanted: the parameters whose summed variance counts.
        residual: of the fit; 0 at pixels that are not fitted.
        variance: of a pixel's residual.

    Source: Conley 1999, GMM estimation with cross sectional dependence; Politis & Romano 1995, the flat-top window.
    """
    influence = inverse_normal[:, wanted] @ jacobian
    pull = cell_sums(influence * residual[:, None])
    share = cell_sums(influence[:, :, None] * jacobian[:, None])
    variance = variance.clamp(min=torch.finfo(residual.dtype).tiny)

    def gain(cells: int) -> Tensor:
        """Gain by blocks of ``cells x cells`` cells."""
        observed = block_sums(pull, cells).square().sum((1, 2))
        shares = block_sums(share, cells)
        # A pixel is in as many blocks as a block has cells; the fit explains a part of each block's noise.
        independent = cells**2 * influence.square().sum((1, 2))
        explained = (shares * (inverse_normal[:, None] @ shares)).sum((1, 2, 3))
        return observed / (variance * (independent - explained))

    return 2 * gain(_LONG) - gain(_SHORT)


def cell_sums(values: Float[Tensor, "*batch pixels"]) -> Float[Tensor, "*batch rows columns"]:
    """Sums of square windows over square cells, about eight across; cells beyond the window's end count as 0."""
    size = math.isqrt(values.shape[-1])
    cell = max(round(size / _CELLS), 1)
    fill = -size % cell
    windows = F.pad(values.reshape(-1, size, size), (0, fill, 0, fill))
    return (F.avg_pool2d(windows, cell) * cell**2).unflatten(0, values.shape[:-1])


def block_sums(cells: Float[Tensor, "*batch rows columns"], across: int) -> Float[Tensor, "*batch blocks"]:
    """Sums over all blocks of ``across x across`` cells that overlap the window, as one row for each window."""
    padded = F.pad(cells.flatten(0, -3), (across - 1,) * 4)
    return (F.avg_pool2d(padded, across, 1) * across**2).flatten(1).unflatten(0, cells.shape[:-2])
