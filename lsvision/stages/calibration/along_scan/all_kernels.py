"""The errors along the scan where edges show them on every line: which kernels and waves they are of, and how large.

Corners alone leave several kernels possible, and the search averages over them. On every line a vibration shows as it
is. Four kinds of spectra are tried: all kernels together, waves that never lose their phase beside broad-band kernels,
broad-band kernels together, and each of these alone. The variances of each are those of the greatest restricted
likelihood, see ``variances``. The most probable kind counts, its parameters integrated over: so many kernels as all
together fit any motion, a random one as a sum of a few waves, and n then seems surer than it is. Of broad-band kernels
the mean counts: how long a random motion is shows on few lengths of it, and n is the less certain the longer it is.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from lsvision.stages.calibration.along_scan.edges import EdgeRows
from lsvision.stages.calibration.along_scan.evidence import Linearised, NormalEquations
from lsvision.stages.calibration.along_scan.kernels import BROAD, FINE, kernel_family
from lsvision.stages.calibration.along_scan.parameters import Scores, climbed, log_probability, usual_variance
from lsvision.stages.calibration.along_scan.search import FoundErrors, evidence_by_component, evidence_of
from lsvision.stages.calibration.along_scan.spectrum import Spectrum
from lsvision.stages.calibration.along_scan.variances import as_large_as_probable, stepped
from lsvision.stages.calibration.along_scan.waves import of_all, of_waves, with_waves
from lsvision.stages.calibration.problem import BoardProblem

_STEPS, _STEPS_NEARBY = 30, 10
_CAREFUL = 20  # steps with the root; later ones go twice as far
_STEPS_BROAD, _STEPS_ALONE, _FAR_ALONE = 24, 10, 4
_CLIMBED = 4
_NOTHING = 1e-12  # of a component's variance


def search_with_edges(
    problem: BoardProblem, linearised: Linearised, edges: EdgeRows, near: Spectrum | None = None
) -> FoundErrors:
    """The errors along the scans of a problem of batch shape (), given corners and edges.

    Args:
        near: a spectrum that the search begins near to: of the same kernels, and as many waves.
    """
    return most_probable_errors(NormalEquations.of(problem, linearised, FINE, edges), near)


def most_probable_errors(equations: NormalEquations, near: Spectrum | None = None) -> FoundErrors:
    """The errors along the scans given the normal equations of all data at the fine knots.

    Args:
        near: as of ``search_with_edges``.
    """
    if near is not None and not near.waves and not near.variances[:, BROAD:].any():
        return found_errors(equations, near, near)  # a mean over kernels is nothing that steps lead to
    spectrum = _most_probable(equations) if near is None else stepped(equations, near, _STEPS_NEARBY)
    if spectrum.waves:
        spectrum = climbed(equations, spectrum, _CLIMBED)
    return found_errors(equations, spectrum, as_large_as_probable(equations, spectrum))


def found_errors(equations: NormalEquations, spectrum: Spectrum, probable: Spectrum) -> FoundErrors:
    """The errors of a spectrum of greatest posterior, which is as large as ``probable`` in the mean."""
    factor_of_shared = Scores.of(equations, spectrum).factor_of_shared
    kept = probable.variances > _NOTHING * probable.total.amax()
    probable = replace(probable, variances=torch.where(kept, probable.variances, 0.0))
    evidence, log_ratio = evidence_by_component(equations, probable.covariance(FINE)[None])
    return FoundErrors(probable, log_ratio, probable.total.sqrt(), float(evidence), factor_of_shared)


def _most_probable(equations: NormalEquations) -> Spectrum:
    """The spectrum of the most probable kind; those that cannot be it, as their evidence alone is less, are skipped."""
    usual = usual_variance(equations)
    count = len(kernel_family(FINE).log_prior)
    kernels = stepped(equations, Spectrum.of_kernels((usual / count).expand(-1, count)), _STEPS, _STEPS - _CAREFUL)
    best = with_waves(equations, kernels)
    value = of_waves(equations, best) if best.waves else of_all(equations, best)
    if evidence_of(equations, kernels.covariance(FINE)) > value:
        kernels = stepped(equations, kernels, _STEPS, _STEPS)
        value, best = max((value, best), (of_all(equations, kernels), kernels), key=_first)
    together = torch.zeros_like(kernels.variances)
    together[:, :BROAD] = usual / BROAD
    broad = stepped(equations, Spectrum.of_kernels(together), _STEPS_BROAD, _STEPS_BROAD - _CAREFUL)
    if evidence_of(equations, broad.covariance(FINE)) <= value:
        return best
    random = [(log_probability(equations, broad, BROAD), broad)]
    for kernel in range(BROAD):
        alone = torch.zeros_like(together)
        alone[:, kernel] = usual[:, 0] / 2.0
        single = stepped(equations, Spectrum.of_kernels(alone), _STEPS_ALONE, _FAR_ALONE)
        random.append((log_probability(equations, single, 1) - math.log(BROAD), single))
    return best if value > max(random, key=_first)[0] else _mean(random)


def _mean(kinds: Sequence[tuple[float, Spectrum]]) -> Spectrum:
    """The mean of spectra without waves, each as probable as its logarithm says."""
    share = torch.tensor([value for value, _ in kinds], dtype=torch.float64).softmax(0)
    return Spectrum.of_kernels(
        sum(part * kind.variances for part, (_, kind) in zip(share.tolist(), kinds, strict=True))
    )


def _first(pair: tuple[float, Spectrum]) -> float:
    return pair[0]
