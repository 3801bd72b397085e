"""The variances of all kernels and waves at once: steps to those of the greatest restricted likelihood.

Each is multiplied, again and again, by how much its process shows over how much it should,

    v_k <- v_k √(Σ αᵀ K_k α / (Σ tr(K_k P) + 2 / s²)),

P the precision of the data at the knots with poses and n projected out, α what it makes of the data, the sums over all
boards. A variance is exponentially distributed beforehand, its mean s² that of the residuals: long waves, many times
larger, could stand for any n otherwise. No step lowers the posterior density, and none leaves the range.

Source: Zhou, Hu, Zhou & Lange 2019, MM algorithms for variance components models; Patterson & Thompson 1971.
"""

import torch

from lsvision.stages.calibration.along_scan.evidence import NormalEquations
from lsvision.stages.calibration.along_scan.kernels import FINE
from lsvision.stages.calibration.along_scan.parameters import correlations, usual_variance
from lsvision.stages.calibration.along_scan.projected import Projected
from lsvision.stages.calibration.along_scan.spectrum import Spectrum

_MOST = 1e3  # that a variance is multiplied by
_FEWEST_SQUARES = 4.0  # that a variance counts as known by


def stepped(equations: NormalEquations, spectrum: Spectrum, steps: int, far: int = 0) -> Spectrum:
    """A spectrum of greater posterior density, at the same frequencies; the last ``far`` steps go twice as far."""
    usual, correlation = usual_variance(equations), correlations(spectrum)
    kernels = spectrum.variances.shape[-1]
    variances = torch.cat([spectrum.variances, spectrum.of_waves], dim=-1)
    for step in range(steps):
        data = Projected.of(equations, torch.tensordot(variances, correlation, 1))
        shown = torch.einsum("bci,kij,bcj->ck", data.weighed, correlation, data.weighed)
        expected = torch.einsum("kij,bcij->ck", correlation, data.own)
        ratio = (shown / (expected + 2.0 / usual)).clamp(0.0, _MOST)
        variances = variances * (ratio if step >= steps - far else ratio.sqrt())
    return Spectrum(variances[:, :kernels], spectrum.frequency, variances[:, kernels:])


def as_large_as_probable(equations: NormalEquations, spectrum: Spectrum) -> Spectrum:
    """The variances of kernels at their mean, not at the most probable value.

    A variance that follows from few squares, of a process that each board shows once, may well be larger:
    v_k Σ tr(K_k P) is their number ν, and ν / (ν - 2) the mean of what is probable over what is most probable.
    """
    data = Projected.of(equations, spectrum.covariance(FINE))
    correlation = correlations(spectrum)[: spectrum.variances.shape[-1]]
    expected = torch.einsum("kij,bcij->ck", correlation, data.own)
    squares = (spectrum.variances * expected).clamp(min=_FEWEST_SQUARES)
    return Spectrum(spectrum.variances * squares / (squares - 2.0), spectrum.frequency, spectrum.of_waves)
