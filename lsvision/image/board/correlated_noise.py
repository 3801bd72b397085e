"""How much more a fit scatters when the residuals of neighbouring pixels are correlated."""

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
    size: int,
) -> Float[Tensor, " fits"]:
    """Variance of the wanted parameters of least-squares fits, over the one that independent noise would give.

    The sandwich estimator: sums of ``influence x residual`` over overlapping blocks of pixels, squared and added, are
    the variance under noise that is correlated within a block. Each is divided by what the same sums come to when the
    noise is independent and the fit has taken its share of it, so that the gain is 1 there, whatever the window. Blocks
    see the pixels at their two ends less often than neighbours; twice the long ones' less the short ones' does not.

    Args:
        jacobian: derivative of square windows, ``pixels = size²``, by the parameters; 0 at pixels left out.
        inverse_normal: inverse of ``J Jᵀ``.
        wanted: the parameters whose summed variance counts.
        residual: of the fit; 0 at pixels left out. variance: of a pixel's residual.

    Source: Conley 1999, GMM estimation with cross sectional dependence; Politis & Romano 1995, the flat-top window.
    """
    influence = inverse_normal[:, wanted] @ jacobian
    products = (influence[:, :, None] * jacobian[:, None]).flatten(1, 2)
    cells = _cell_sums(torch.cat([influence * residual[:, None], products], dim=1), size)
    white = variance.clamp(min=torch.finfo(residual.dtype).tiny), influence.square().sum((1, 2))
    short, long = (_gain(cells, inverse_normal, influence.shape[1], white, block) for block in (_SHORT, _LONG))
    return 2 * long - short


def _gain(cells: Tensor, inverse_normal: Tensor, count: int, white: tuple[Tensor, Tensor], block: int) -> Tensor:
    """Gain by blocks of ``block x block`` cells."""
    sums = F.avg_pool2d(F.pad(cells, (block - 1,) * 4), block, 1).flatten(2) * block**2
    scatter, products = sums[:, :count].square().sum((1, 2)), sums[:, count:].unflatten(1, (count, -1))
    # A pixel is in as many blocks as a block has cells; the fit takes its share out of each block's residuals.
    variance, own = white
    taken = (products * (inverse_normal[:, None] @ products)).sum((1, 2, 3))
    return scatter / (variance * (block**2 * own - taken))


def _cell_sums(values: Tensor, size: int) -> Tensor:
    """Sums of (fits, k, pixels) over square cells, (fits, k, rows, columns)."""
    cell = max(round(size / _CELLS), 1)
    fill = -size % cell
    return F.avg_pool2d(F.pad(values.unflatten(-1, (size, size)), (0, fill, 0, fill)), cell) * cell**2
