"""The waves of a vibration: their frequencies, from what narrow-band kernels show, and whether waves are more probable.

The kernels' variances say roughly where waves are. Each begins there, with broad-band kernels beside it, and its
frequency follows the gradient of the restricted likelihood: it ends up known to some thousandths of a wave per board,
where a kernel is known to a tenth. What two waves beat like is first taken for one: where what the waves leave shows
another frequency, a further wave is tried, and so are two in place of each long one. Two of nearly one frequency, as
components have that begin apart, are tried as one. Waves are kept where they make the data more probable than kernels
alone, the freedom of their frequencies allowed for.

Source: Solin & Särkkä 2014; MacKay 2003, Information Theory, Inference, and Learning Algorithms, ch. 28.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.stages.calibration.along_scan.evidence import NormalEquations
from lsvision.stages.calibration.along_scan.kernels import BROAD, FINE, narrow_frequencies
from lsvision.stages.calibration.along_scan.parameters import (
    Scores,
    climbed,
    log_probability,
    moved,
    usual_variance,
)
from lsvision.stages.calibration.along_scan.projected import Projected
from lsvision.stages.calibration.along_scan.spectrum import MOST_WAVES, Spectrum, wave_correlations
from lsvision.stages.calibration.along_scan.variances import stepped

_WIDTH = 0.26  # waves per unit within which kernels show the same wave
_LEAST_SHARE = 0.05  # of the components' variance, that a wave has at first
_FAINT = 0.01  # of the largest component's variance: what components of less show is no wave's frequency
_BEGIN = 1e-3  # variance of each broad-band kernel at first, of that of the residuals
_ROUNDS, _STEPS, _CLIMBED = 8, 2, 24
_APART, _LONG = 0.1, 2.0  # waves per unit: between those that may beat, and below which n depends on it
_TWINS = 0.1  # waves per unit within which two are tried as one
_RESOLVED = 0.1  # waves per unit to which a wave's frequency is known
_FREE = 4.0  # of the information on a frequency, that keeps a step short where there is none
_TRIED = torch.arange(0.3, 8.01, 0.05, dtype=torch.float64)
_IMPROBABLE = 1e-6  # probability of what a frequency shows beyond the waves, below which it is tried as one more


def with_waves(equations: NormalEquations, kernels: Spectrum) -> Spectrum:
    """The spectrum of waves and kernels that the data are most probable under; the given one where no waves are."""
    best = _begun(equations, kernels)
    if not best.waves:
        return kernels
    best = _without_twins(equations, _settled(equations, best))
    while best.waves < MOST_WAVES:
        further = _better(equations, best)
        if further is None:
            break
        best = _without_twins(equations, further)
    return best if of_waves(equations, best) > of_all(equations, kernels) else kernels


def _better(equations: NormalEquations, spectrum: Spectrum) -> Spectrum | None:
    """A more probable spectrum of one wave more; None where none is found."""
    least = of_waves(equations, spectrum)
    return next(
        (further for further in _of_one_more(equations, spectrum) if of_waves(equations, further) > least), None
    )


def _of_one_more(equations: NormalEquations, spectrum: Spectrum) -> Iterator[Spectrum]:
    """Spectra of one wave more: that which the data show most, and with two in place of each long one, largest first.

    Two waves that beat are taken for one, with something broad or another wave of twice the frequency.
    """
    further = _one_more(equations, spectrum)
    if further is not None:
        yield further
    for wave in spectrum.of_waves.sum(0).argsort(descending=True):
        if bool(spectrum.frequency[wave] < _LONG):
            yield _settled(equations, _parted(equations, spectrum, wave))


def of_waves(equations: NormalEquations, spectrum: Spectrum) -> float:
    """Log evidence for waves beside broad-band kernels."""
    return log_probability(equations, spectrum, BROAD)


def of_all(equations: NormalEquations, kernels: Spectrum) -> float:
    """Log evidence for kernels, any of all."""
    return log_probability(equations, kernels, kernels.variances.shape[-1])


def _begun(equations: NormalEquations, kernels: Spectrum) -> Spectrum:
    """Waves where narrow-band kernels are strong, and some broad-band errors."""
    frequency, strength = narrow_frequencies(kernels.variances)
    total = kernels.total
    strength = (strength / torch.maximum(total, _FAINT * total.amax())[:, None]).sum(0)
    found: list[float] = []
    while len(found) < MOST_WAVES:
        near = (frequency - frequency[strength.argmax()]).abs() < _WIDTH
        share = strength[near].sum()
        if not bool(share > _LEAST_SHARE):
            break
        found.append(float((strength * frequency)[near].sum() / share))
        strength = torch.where(near, 0.0, strength)
    waves = (kernels.total[:, None] / max(len(found), 1)).expand(-1, len(found))
    return Spectrum(_broad(equations, kernels), frequency.new_tensor(found), waves)


def _broad(equations: NormalEquations, like: Spectrum) -> Float[Tensor, "4 kernels"]:
    """Variances of the broad-band kernels beside waves, at first."""
    broad = torch.zeros_like(like.variances)
    broad[:, :BROAD] = _BEGIN * usual_variance(equations)
    return broad


def _parted(equations: NormalEquations, spectrum: Spectrum, wave: Tensor) -> Spectrum:
    """A spectrum with two waves in place of one."""
    kept = torch.arange(spectrum.waves) != wave
    frequency, half = spectrum.frequency[wave, None], spectrum.of_waves[:, wave, None] / 2
    return Spectrum(
        _broad(equations, spectrum),
        torch.cat([spectrum.frequency[kept], frequency - _APART, frequency + _APART]),
        torch.cat([spectrum.of_waves[:, kept], half, half], dim=-1),
    )


def _settled(equations: NormalEquations, spectrum: Spectrum) -> Spectrum:
    """Frequencies and variances near the most probable ones; waves of no known frequency are none."""
    for _ in range(_ROUNDS):
        spectrum = stepped(equations, spectrum, _STEPS)
        scores = Scores.of(equations, spectrum)
        count = len(scores.active)
        eye = torch.eye(spectrum.waves, dtype=spectrum.frequency.dtype, device=spectrum.frequency.device)
        information = scores.information[count:, count:] + _FREE * eye
        step = torch.linalg.solve(information, scores.gradient[count:])
        spectrum = moved(spectrum, scores.active[:0], step)
    scores = Scores.of(equations, spectrum)
    resolved = scores.frequency_sigma < _RESOLVED
    spectrum = replace(spectrum, frequency=spectrum.frequency[resolved], of_waves=spectrum.of_waves[:, resolved])
    return climbed(equations, spectrum, _CLIMBED) if spectrum.waves else spectrum


def _without_twins(equations: NormalEquations, spectrum: Spectrum) -> Spectrum:
    """Waves of nearly one frequency made one where that is more probable: components begun apart may have one each."""
    while spectrum.waves > 1:
        order = spectrum.frequency.argsort()
        gap = spectrum.frequency[order].diff()
        twins = order[gap.argmin() + torch.arange(2)]
        if not bool(gap.min() < _TWINS):
            break
        joined = _settled(equations, _joined(spectrum, twins))
        if of_waves(equations, joined) <= of_waves(equations, spectrum):
            break
        spectrum = joined
    return spectrum


def _joined(spectrum: Spectrum, twins: Int[Tensor, "2"]) -> Spectrum:
    """With one wave in place of two, between their frequencies, as large as both."""
    share = (spectrum.of_waves[:, twins] / spectrum.total[:, None].clamp(min=1e-300)).sum(0)
    frequency, variance = spectrum.frequency.clone(), spectrum.of_waves.clone()
    frequency[twins[0]] = (share * frequency[twins]).sum() / share.sum()
    variance[:, twins[0]] = variance[:, twins].sum(1)
    kept = torch.arange(spectrum.waves) != twins[1]
    return replace(spectrum, frequency=frequency[kept], of_waves=variance[:, kept])


def _one_more(equations: NormalEquations, spectrum: Spectrum) -> Spectrum | None:
    """A spectrum with a wave of the frequency that the data show most beyond the others, None where they show none.

    What broad-band kernels took of a beat is given back.
    """
    spectrum = replace(spectrum, variances=_broad(equations, spectrum))
    data = Projected.of(equations, spectrum.covariance(FINE))
    tried = _TRIED.to(data.weighed)
    wave = wave_correlations(tried, FINE)
    shown = torch.einsum("bci,fij,bcj->fbc", data.weighed, wave, data.weighed)
    expected = torch.einsum("fij,bcij->fbc", wave, data.own)
    ratio = (shown / expected.clamp(min=1e-300)).sum((-2, -1))
    freedom = 2.0 * data.weighed.shape[0] * data.weighed.shape[1]
    best = int(ratio.argmax())
    if not bool(chi_square_tail(2.0 * ratio[best], freedom) * len(tried) < _IMPROBABLE):
        return None
    variance = _LEAST_SHARE * spectrum.total[:, None]
    further = Spectrum(
        spectrum.variances,
        torch.cat([spectrum.frequency, tried[best : best + 1]]),
        torch.cat([spectrum.of_waves, variance], dim=-1),
    )
    return _settled(equations, further)
