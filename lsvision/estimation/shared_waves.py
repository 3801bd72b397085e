"""How large the processes are that share a signal (``shared_signal``): the likeliest parts of both.

Both processes, a and b, are sums of a broad part, Matérn of smoothness 3/2 with a length of its own, and of waves,
which have the same wavelength and coherence in a and b. Waves are added one by one, where the periodogram of m exceeds
its expectation most. Waves that periodograms do not separate are found afterwards (``shared_neighbours``).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lsvision.estimation.shared_neighbours import with_neighbours
from lsvision.estimation.shared_parts import Part
from lsvision.estimation.shared_periodograms import Periodograms
from lsvision.estimation.shared_signal import SharedModel, SharedSignal

_STEPS = {"broad": (0.7, 0.7, 0.7, 0.7), "wave": (0.7, 0.7, 0.7, 0.5)}  # first ones, of the logarithms
_LEAST_STEP = 0.1  # of the first ones
_LEAST_GAIN = 1e-3  # of the density's logarithm, that is worth another step
_BOTH = (True, True)
_FAINT = 0.05  # of the usual sigma
_MOST_WAVES = 6
_WORTH = 10.0  # by how much a wave must add to the logarithm of the likelihood
_ROUNDS = 2  # of searching all parts in turn


@dataclass(frozen=True)
class SharedFit:
    """The likeliest parts, and by how much the process a, and b, adds to the logarithm of the likelihood.

    With ``neighbours``, waves that periodograms show as one, the evidence, which is theirs, may be too small.
    """

    parts: tuple[Part, ...]
    evidence: tuple[float, float]
    neighbours: bool = False

    @property
    def model(self) -> SharedModel:
        """The processes for the smoother."""
        one, other = ([part.process(which) for part in self.parts] for which in range(2))
        return SharedModel(one, other)

    def sigma(self, process: int) -> float:
        """Standard deviation of a (0) or b (1)."""
        return math.sqrt(sum(float(part.sigma[process]) ** 2 for part in self.parts))


def fit_shares(data: SharedSignal, sigma: float, length: float) -> SharedFit:
    """Find the likeliest parts of the two processes.

    Args:
        sigma, length: usual ones, about which the search begins; length in samples.
    """
    waves = Periodograms.of(data)
    usual = Part("broad", data.total.new_full((2,), sigma), data.total.new_full((2,), length))
    # A broad part that explains all leaves no wave to be found, a faint one leaves all.
    faint = replace(usual, sigma=_FAINT * usual.sigma)
    fits = [_grown(waves, _fitted(waves, (usual,), _BOTH)), _grown(waves, _Fit((faint,), -math.inf))]
    both = max(fits, key=lambda fit: fit.density)
    alone = [_fitted(waves, both.parts, kept).density for kept in ((False, True), (True, False))]
    evidence = both.density - alone[0], both.density - alone[1]
    # The longer a signal, the fewer waves lie within a cycle of each other.
    parts = both.parts if waves.segments > 1 else with_neighbours(both.parts, data)
    return SharedFit(parts, evidence, neighbours=len(parts) > len(both.parts))


@dataclass(frozen=True)
class _Fit:
    parts: tuple[Part, ...]
    density: float


def _grown(waves: "Periodograms", fit: _Fit) -> _Fit:
    """The parts of a fit, and waves as long as they are worth it."""
    for _ in range(_MOST_WAVES):
        others = waves.expected_sum(fit.parts)
        tried = [_search(waves, wave, others, list(map(float, _BOTH))) for wave in waves.missing_waves(fit.parts)]
        wave = max(tried, key=lambda found: found[1])[0]
        more = _fitted(waves, (*fit.parts, wave), _BOTH)
        if more.density < fit.density + _WORTH:
            break
        fit = more
    return fit


def _fitted(waves: "Periodograms", parts: tuple[Part, ...], kept: tuple[bool, bool]) -> _Fit:
    """The likeliest numbers of some parts, one part after the other, the last one first."""
    free = [float(part) for part in kept]
    current, density = [part.only(kept) for part in parts], -math.inf
    for _ in range(_ROUNDS):
        for index in reversed(range(len(current))):
            others = waves.expected_sum(current[:index] + current[index + 1 :])
            current[index], density = _search(waves, current[index], others, free)
    return _Fit(tuple(current), density)


def _search(waves: "Periodograms", part: Part, others: Sequence[Tensor], free: list[float]) -> tuple[Part, float]:
    """The likeliest numbers of one part by ever smaller steps, and the logarithm of the density."""
    like = part.sigma
    steps = like.new_tensor(_STEPS[part.kind])
    if part.kind == "wave":
        steps[2] = float(part.span[0]) / waves.samples / 2
    unit = torch.cartesian_prod(*4 * [like.new_tensor([-1.0, 0.0, 1.0])]) * like.new_tensor([*free, 1.0, 1.0])
    unit = torch.unique(unit, dim=0)
    point, scale, best = like.new_zeros(4), 1.0, -math.inf
    while scale > _LEAST_STEP:
        candidates = point + scale * steps * unit
        moved = part.moved(candidates)
        expected = [a + b for a, b in zip(waves.expected(moved), others, strict=True)]
        density = waves.log_likelihood(expected) + waves.log_prior(moved, like.new_tensor(free))
        density = density.nan_to_num(-math.inf, neginf=-math.inf)
        winner = int(density.argmax())
        if float(density[winner]) < best + _LEAST_GAIN or math.isinf(float(density[winner])):
            scale /= 2
        if float(density[winner]) > best:
            point, best = candidates[winner], float(density[winner])
    return part.moved(point[None]).at(0), best
