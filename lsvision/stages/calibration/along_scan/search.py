"""The search for errors along the scan: which processes, of which kernels, the corners of a problem are probable under.

Vibration and encoder errors displace whole lines. Along the travel they are correlated, and what is long in them looks
like n: taken for white noise they leave n many sigmas off. Each component of ``lines`` errs by a sum of Gaussian
processes of its own in every scan, all scans with the same kernels, which are looked for among those of ``kernels``.
Weighed by its probability each contributes to the covariance that the estimate then assumes. Averaged, not the
most probable alone: long waves hardly show once poses and n are fitted, and n must not be surer than that.

Components mostly vibrate at the same wavelengths: one that is found in depth is expected sideways too.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.evidence import Linearised, NormalEquations
from lsvision.stages.calibration.along_scan.kernels import (
    AMPLITUDES,
    KNOTS,
    SEARCHED,
    KernelFamily,
    Knots,
    kernel_family,
)
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Travel
from lsvision.stages.calibration.along_scan.spectrum import Spectrum
from lsvision.stages.calibration.problem import BoardProblem

_COUNT = len(COMPONENTS)
_SWEEPS = 2
_SHOWN = 1.5  # size of errors at most, as it is reported, in units of the residuals' rms
_PROCESSES = 2  # of a component, that add up
_PRESENT = (0.2, 0.1)  # prior probabilities of a component's first process, and of its second where the first is there
_THERE = 0.5  # probability of a process from which a further one is looked for
_SHARED = 0.5  # prior probability that all components err at the same wavelengths


@dataclass(frozen=True)
class Beforehand:
    """What is known before the search.

    Attributes:
        process_sigma: of the random walk of n per square root of a mm; what it explains is no error along the scan.
        odds: how many times more probable than white noise alone errors along the scan must make the corners. Sound
            corners do so with a probability of at most one in ``odds`` (Markov's inequality).
    """

    process_sigma: float
    odds: float


@dataclass(frozen=True)
class FoundErrors:
    """The spectrum of the errors of each component, and the log evidence for them.

    ``rms_mm`` of each component is the most probable one, and little more than the residuals show: a covariance that is
    a mean over amplitudes is larger, above all that of waves of which most is taken for poses and n.
    ``log_ratio`` is how much more probable the corners are with the errors of each component than without.
    ``factor_of_shared`` is that of what the covariance of n, and of what else all boards share, owes to the spectrum,
    which is known no better than the data show it.
    The constant that is missing in the evidence is the same for all linearisations of a problem.
    """

    spectrum: Spectrum
    log_ratio: Float[Tensor, "4"]
    rms_mm: Float[Tensor, "4"]
    log_evidence: float
    factor_of_shared: Float[Tensor, "shared shared"]

    def covariance(self, knots: Knots) -> Float[Tensor, "4 knots knots"]:
        """Covariance of the errors of each component at knots, mm²."""
        return self.spectrum.covariance(knots)


def search(problem: BoardProblem, linearised: Linearised, known: Beforehand) -> FoundErrors | None:
    """The errors along the scan of one problem, None where the evidence for them is below the odds."""
    return _Search.of(problem, linearised, known).found(math.log(known.odds))


@dataclass
class _Search:
    """Coordinate by coordinate: the weights of all kernels of one component, the other components as they stand.

    Each component has several processes, each for what those before it leave: errors of several wavelengths.
    """

    equations: NormalEquations
    family: KernelFamily
    covariances: Float[Tensor, "4 processes knots knots"]
    variances: Float[Tensor, "4 processes kernels"]
    rms_mm: Float[Tensor, "4 processes"]  # geometric means
    by_kernel: Float[Tensor, "4 kernels"]  # log likelihood ratio to no error; that there is none has its part in it
    walk: Float[Tensor, "_ 4 knots knots"]  # covariance of what a walk of n explains, by board

    @classmethod
    def of(cls, problem: BoardProblem, linearised: Linearised, known: Beforehand) -> "_Search":
        """A search in one problem that has found nothing yet."""
        like = linearised.columns
        family = kernel_family().to(like)
        kernels = len(family.log_prior)
        walk = like.new_zeros(1, _COUNT, KNOTS, KNOTS)
        if known.process_sigma:
            walk = Travel.of(problem).walk(known.process_sigma, SEARCHED)
        return cls(
            equations=NormalEquations.of(problem, linearised),
            family=family,
            covariances=like.new_zeros(_COUNT, _PROCESSES, KNOTS, KNOTS),
            variances=like.new_zeros(_COUNT, _PROCESSES, kernels),
            rms_mm=like.new_zeros(_COUNT, _PROCESSES),
            by_kernel=like.new_zeros(_COUNT, kernels),
            walk=walk,
        )

    def found(self, log_odds: float) -> FoundErrors | None:
        """The errors that the corners show."""
        alone = [self._log_ratios(component, 0) for component in range(_COUNT)]
        by_component = torch.stack([torch.logsumexp((a + self.family.log_prior[:, None]).flatten(), 0) for a in alone])
        evidence = torch.logsumexp(by_component, 0) - math.log(_COUNT * len(AMPLITUDES))
        if not bool(evidence > log_odds):
            return None
        # The component that errs most comes first: what it explains is no error of the others.
        order = by_component.argsort(descending=True).tolist()
        for _ in range(_SWEEPS):  # the second knows of the other components and processes
            first = [self._weigh_first(component) for component in order]
            for layer in range(1, _PROCESSES):
                for component, weighed in zip(order, first, strict=True):
                    if weighed.present > _THERE:
                        self._weigh(component, layer, self.family.log_prior)
        evidence, log_ratio = evidence_by_component(self.equations, self.covariances.sum(1) + self.walk)
        rms = torch.minimum(self.rms_mm.square().sum(-1).sqrt(), _SHOWN * self.equations.rms_mm)
        spectrum = Spectrum.of_kernels(self.variances.sum(1))
        return FoundErrors(spectrum, log_ratio, rms, float(evidence), rms.new_zeros(3, 3))

    def _weigh_first(self, component: int) -> "_Weighed":
        """Weigh the first process of a component."""
        weights = self._weigh(component, 0, self._shared_prior(component))
        self.by_kernel[component] = weights.by_kernel
        return weights

    def _weigh(self, component: int, layer: int, log_prior: Tensor) -> "_Weighed":
        """Set the covariance of one process to its mean over kernels and amplitudes."""
        present, absent = math.log(_PRESENT[layer]), math.log(1.0 - _PRESENT[layer])
        ratios = self._log_ratios(component, layer) - math.log(len(AMPLITUDES))
        joint = ratios + log_prior[:, None] + present
        none = torch.logsumexp(log_prior, 0) + absent
        evidence = torch.logaddexp(torch.logsumexp(joint.flatten(), 0), none)
        weights = torch.exp(joint - evidence)
        variances = self._variances(component)
        probability = weights.sum().clamp(min=1e-300)
        log_variance = (weights * variances.log()).sum() / probability
        self.rms_mm[component, layer] = (probability * log_variance.exp()).sqrt()
        self.variances[component, layer] = by_variance = (weights * variances).sum(-1)
        self.covariances[component, layer] = torch.tensordot(by_variance, self.family.covariance, 1)
        by_kernel = torch.logsumexp(ratios, -1) + present
        return _Weighed(torch.logaddexp(by_kernel, by_kernel.new_tensor(absent)), float(probability))

    def _log_ratios(self, component: int, layer: int) -> Tensor:
        """Log likelihood ratios of a process of each kernel and amplitude to none, the others as they stand."""
        standing = self.covariances.clone()
        standing[component, layer] = 0.0
        given = self.equations.given(component, *_present(standing.sum(1) + self.walk))
        return self.equations.log_ratios(given, self.family, self._variances(component))

    def _variances(self, component: int) -> Tensor:
        """The variances to try, mm²."""
        rms = self.equations.rms_mm[component]
        return (rms * rms.new_tensor(AMPLITUDES)).square()

    def _shared_prior(self, component: int) -> Tensor:
        """Log prior of the kernels of a component, given what the other components show."""
        prior = self.family.log_prior
        others = [self.by_kernel[other] for other in range(_COUNT) if other != component]
        ratio = sum((other - torch.logsumexp(other + prior, 0) for other in others), torch.zeros_like(prior))
        return prior + torch.logaddexp(ratio + math.log(_SHARED), prior.new_tensor(math.log(1.0 - _SHARED)))


def evidence_of(equations: NormalEquations, covariance: Float[Tensor, "4 knots knots"]) -> float:
    """The log evidence for errors of some covariance, mm²."""
    return float(equations.log_evidence(*_present(covariance[None])))


def evidence_by_component(
    equations: NormalEquations, covariance: Float[Tensor, "_ 4 knots knots"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "4"]]:
    """The log evidence for errors of some covariance, mm², and how much of it is lost without each component."""
    evidence = equations.log_evidence(*_present(covariance))
    without = []
    for component in range(_COUNT):
        rest = covariance.clone()
        rest[:, component] = 0.0
        without.append(equations.log_evidence(*_present(rest)))
    return evidence, evidence - torch.stack(without)


def _present(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Which components err at all, and the roots of their covariances."""
    present = covariance.flatten(-2).any(-1).any(0).nonzero()[:, 0]
    return present, covariance_root(covariance[:, present])


@dataclass(frozen=True)
class _Weighed:
    """Log likelihood ratio by kernel, none included, and the probability that a process is there."""

    by_kernel: Float[Tensor, " kernels"]
    present: float
