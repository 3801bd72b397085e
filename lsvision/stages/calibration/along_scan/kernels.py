"""The kernels among which the errors along a scan are looked for, on knots spread over the boards' travel.

Lengths are in units of the largest travel that a board of the problem takes, so that one table serves all problems.
Errors that are longer than four of them are a motion n to every observer, and belong to it.
"""

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import (
    covariance_root,
    cubic_weights,
    exponential,
    matern32,
    narrow_band,
)

KNOTS = 32
INTERVALS = KNOTS - 3  # over the travel; interpolation takes one more knot at each end

# Lengths of broad-band errors. Rough ones (exponential) that are shorter look like smooth ones (Matérn). Longer ones
# are drifts: on a few boards they look much like shorter ones, and they would dominate the mean over kernels.
_ROUGH_LENGTHS = (0.25, 0.5)
_SMOOTH_LENGTHS = (0.0625, 0.125, 0.25, 0.5)
# Waves per unit. Of those that soon lose their phase, neighbours nearer than a quarter look alike.
_FADING_FREQUENCIES = (0.25, 0.35, 0.5, *(0.25 * k for k in range(3, 17)))
_SHORT_FREQUENCIES = tuple(0.25 * k for k in range(17, 33))  # which only finer knots describe, and edges show
_LASTING_FREQUENCIES = tuple(0.25 * 2.0 ** (k / 6) for k in range(25))
_FADING, _LASTING = 2.0, 8.0  # coherence of waves: how far one keeps its phase
_FADING_RANK, _LASTING_RANK = 16, 8  # of their covariances, the rest of which is rounding
BROAD = len(_ROUGH_LENGTHS) + len(_SMOOTH_LENGTHS)
"""Number of broad-band kernels, which come first."""
_TABLES = 4  # of correlations that are kept: knots reach as far as each problem's scans
# Amplitudes, in units of the residuals' rms: prior log-uniform between them.
AMPLITUDES = tuple(2.0**k for k in range(-5, 5))


@dataclass(frozen=True)
class KernelFamily:
    """Kernels of variance one at the knots, their roots, and the logarithm of their prior probabilities.

    ``roots`` are those of some kernels after the other, in groups of as many columns.
    """

    covariance: Float[Tensor, "kernels knots knots"]
    roots: tuple[Float[Tensor, "_ knots _"], ...]
    log_prior: Float[Tensor, " kernels"]

    def to(self, like: Tensor) -> "KernelFamily":
        """The same in the dtype and on the device of a tensor."""
        roots = tuple(group.to(like) for group in self.roots)
        return KernelFamily(self.covariance.to(like), roots, self.log_prior.to(like))


@dataclass(frozen=True)
class Knots:
    """Evenly spaced knots along the travel.

    Attributes:
        density: how many times as dense as those on which the corners are searched.
        before, after: how many more there are than over the board.
    """

    density: int = 1
    before: int = 0
    after: int = 0

    @property
    def intervals(self) -> int:
        """Number of intervals over a unit."""
        return INTERVALS * self.density

    @property
    def count(self) -> int:
        """Number of knots."""
        return self.intervals + 3 + self.before + self.after

    def weights(self, place: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch knots"]:
        """Weights of the knots at places in units from the begin of the board; beyond the last knot, those there."""
        position = (1.0 + self.before) + self.intervals * place
        return cubic_weights(position.clamp(1.0, self.count - 2.0), self.count)

    def place(self, like: Tensor) -> Float[Tensor, " knots"]:
        """Places of the knots."""
        number = torch.arange(self.count, dtype=like.dtype, device=like.device)
        return (number - (1.0 + self.before)) / self.intervals


SEARCHED = Knots()
"""Those at which the errors are looked for."""
FINE = Knots(density=2)
"""Those at which they are described: between them interpolation leaves nothing of a wave that the corners show."""


@cache
def kernel_family(knots: Knots = SEARCHED) -> KernelFamily:
    """All kernels: broad-band errors and waves are as probable, and so are waves that fade and that last."""
    broad, fading, lasting, short = _correlations(knots)
    groups, ranks = [broad, fading, lasting], [knots.count, _FADING_RANK, _LASTING_RANK]
    parts = [0.5, 0.25, 0.25]
    if knots.density > 1:
        groups, ranks = [*groups, short], [*ranks, _FADING_RANK]
        parts = [*parts, 0.25 * len(short) / len(fading)]
    roots = tuple(covariance_root(group)[..., -rank:] for group, rank in zip(groups, ranks, strict=True))
    share = torch.cat(
        [group.new_full((len(group),), part / len(group)) for group, part in zip(groups, parts, strict=True)]
    )
    return KernelFamily(torch.cat(groups), roots, share.log())


def covariance_of(variances: Float[Tensor, "*batch kernels"], knots: Knots) -> Float[Tensor, "*batch knots knots"]:
    """Covariance at knots of a sum of processes of all kernels, each of some variance, mm²."""
    correlation = _all_correlations(knots).to(variances)
    return torch.tensordot(variances, correlation[: variances.shape[-1]], 1)


def narrow_frequencies(
    variances: Float[Tensor, "*batch kernels"],
) -> tuple[Float[Tensor, " narrow"], Float[Tensor, "*batch narrow"]]:
    """Frequencies of the narrow-band kernels, waves per unit, and their variances."""
    frequency = variances.new_tensor((*_FADING_FREQUENCIES, *_LASTING_FREQUENCIES, *_SHORT_FREQUENCIES))
    narrow = variances[..., BROAD:]
    return frequency[: narrow.shape[-1]], narrow


@lru_cache(maxsize=_TABLES)
def _all_correlations(knots: Knots) -> Float[Tensor, "kernels knots knots"]:
    """All kernels between knots, one after the other."""
    return torch.cat(_correlations(knots))


def _correlations(knots: Knots) -> list[Float[Tensor, "_ knots knots"]]:
    """All kernels between knots: broad-band ones, waves that fade, waves that last, short waves that fade."""
    place = knots.place(torch.zeros((), dtype=torch.float64))
    distance = place[:, None] - place
    rough = [exponential(distance / length) for length in _ROUGH_LENGTHS]
    broad = rough + [matern32(distance / length) for length in _SMOOTH_LENGTHS]
    fading = [narrow_band(distance, 1.0 / frequency, _FADING) for frequency in _FADING_FREQUENCIES]
    lasting = [narrow_band(distance, 1.0 / frequency, _LASTING) for frequency in _LASTING_FREQUENCIES]
    short = [narrow_band(distance, 1.0 / frequency, _FADING) for frequency in _SHORT_FREQUENCIES]
    return [torch.stack(group) for group in (broad, fading, lasting, short)]


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
