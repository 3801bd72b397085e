"""The kernels among which the errors along a scan are looked for, on knots spread over the boards' travel.

Lengths are in units of the largest travel that a board of the problem takes, so that one table serves all problems.
Errors that are longer than four of them are a motion n to every observer, and belong to it.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root, exponential, matern32, narrow_band

KNOTS = 32
INTERVALS = KNOTS - 3  # over the travel; interpolation takes one more knot at each end

# Lengths of broad-band errors. Rough ones (exponential) that are shorter look like smooth ones (Matérn). Longer ones
# are drifts, which a few boards hardly tell from shorter ones, and of which the mean over kernels would consist.
_ROUGH_LENGTHS = (0.25, 0.5)
_SMOOTH_LENGTHS = (0.0625, 0.125, 0.25, 0.5)
# Waves per unit. Those nearer to each other than a quarter look alike on one unit, but for the longest.
_FREQUENCIES = (0.25, 0.35, 0.5, *(0.25 * k for k in range(3, 17)))
_COHERENCE = 2.0  # of waves: how far one keeps its phase
_WAVE_RANK = 16  # of a wave's covariance, the rest of which is rounding
# Amplitudes, in units of the residuals' rms: prior log-uniform between them.
AMPLITUDES = tuple(2.0**k for k in range(-5, 5))


@dataclass(frozen=True)
class KernelFamily:
    """Kernels of variance one at the knots, their roots, and the logarithm of their prior probabilities.

    ``broad`` are the roots of the first kernels, ``waves`` those of the rest, which need fewer columns.
    """

    covariance: Float[Tensor, "kernels knots knots"]
    broad: Float[Tensor, "broad knots knots"]
    waves: Float[Tensor, "waves knots rank"]
    log_prior: Float[Tensor, " kernels"]

    def chosen(self, kept: Tensor) -> "KernelFamily":
        """The kernels of a mask, their prior as it was."""
        first = len(self.broad)
        return KernelFamily(
            self.covariance[kept], self.broad[kept[:first]], self.waves[kept[first:]], self.log_prior[kept]
        )

    def to(self, like: Tensor) -> "KernelFamily":
        """The same in the dtype and on the device of a tensor."""
        return KernelFamily(self.covariance.to(like), self.broad.to(like), self.waves.to(like), self.log_prior.to(like))


@cache
def kernel_family() -> KernelFamily:
    """All kernels; broad-band errors and waves are as probable, and so are all of each."""
    place = torch.arange(KNOTS, dtype=torch.float64) / INTERVALS
    distance = place[:, None] - place
    broad = [exponential(distance / length) for length in _ROUGH_LENGTHS]
    broad += [matern32(distance / length) for length in _SMOOTH_LENGTHS]
    waves = [narrow_band(distance, 1.0 / frequency, _COHERENCE) for frequency in _FREQUENCIES]
    covariance = torch.stack(broad + waves)
    share = [0.5 / len(broad)] * len(broad) + [0.5 / len(waves)] * len(waves)
    roots = covariance_root(covariance)
    first = len(broad)
    return KernelFamily(
        covariance, roots[:first], roots[first:, :, -_WAVE_RANK:], torch.tensor(share, dtype=torch.float64).log()
    )


def wave_length(covariance: Float[Tensor, "*batch knots knots"]) -> Float[Tensor, "*batch"]:
    """Length of the wave whose correlation falls to one half where that of a covariance does, in units of the travel.

    It is six times that distance; where it is past the last knot, the length of the knots stands for it.
    """
    lags = [covariance.diagonal(lag, dim1=-2, dim2=-1).mean(-1) for lag in range(KNOTS)]
    correlation = torch.stack(lags, dim=-1) / lags[0][..., None]
    below = (correlation < math.cos(math.pi / 3)).to(torch.long)
    first = torch.where(below.any(-1), below.argmax(-1), KNOTS - 1).clamp(min=1)
    after, before = (correlation.gather(-1, (first - back)[..., None])[..., 0] for back in (0, 1))
    part = ((before - 0.5) / (before - after).clamp(min=1e-12)).clamp(0.0, 1.0)
    return 6.0 * (first - 1 + part) / INTERVALS
