"""Errors that all corners of a line share: found by their evidence, weighed in the estimate, and reported.

Vibration and encoder errors displace whole lines. Along the travel they are correlated, and what is long in them looks
like n: taken for white noise they leave n many sigmas off. Each component of (x, travel, z) errs by a Gaussian process
of its own in every scan, all scans with one kernel, which is looked for among those of ``kernels`` and their sums.
Weighed by its probability each contributes to the covariance that the estimate then assumes. Averaged, not the
most probable alone: long waves hardly show once poses and n are fitted, and n must not be surer than that.

Components mostly vibrate at the same wavelengths: one that is found in depth is expected sideways too.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.evidence import NormalEquations, Travel
from lsvision.stages.calibration.kernels import AMPLITUDES, KNOTS, KernelFamily, kernel_family, wave_length
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.reduction import CorrelatedNoise, rows_with_latents

# Residuals are looked at closely where chance alone would correlate them as much with less than this probability.
_SUSPICION = 0.005
_ORDERS = 10  # of half-waves over the travel, that the residuals are tested for
_PROCESSES = 3  # of a component, that add up
_THERE = 0.5  # probability of a process from which a further one is looked for
_FAINT = -12.0  # log weight, of the largest, below which a kernel is not tried again
_PRESENT = _ABSENT = math.log(0.5)  # log prior probabilities that a component has such an error, that it has none
_SHARED = 0.5  # prior probability that all components err at the same wavelengths


@dataclass(frozen=True)
class ErrorsAlongScan:
    """The errors along the scans of a batch of problems, zero where none were ``found``.

    ``rms_mm`` and ``length_mm`` are those of x, travel and z: the length of a wave as correlated. ``noise`` is the
    corners' noise with these errors, None where none were found in any problem, as given where they were in others.
    """

    found: Bool[Tensor, "*batch"]
    rms_mm: Float[Tensor, "*batch 3"]
    length_mm: Float[Tensor, "*batch 3"]
    noise: CorrelatedNoise | None

    def problem(self, problem: BoardProblem) -> BoardProblem:
        """Those of the problems in which errors were found, in a row, with their noise."""
        return replace(problem, correlated=self.noise).at(self.found)


@dataclass(frozen=True)
class Beforehand:
    """What is known before the search.

    Attributes:
        prior_sigma: of each component of n.
        process_sigma: of the random walk of n per square root of a mm; what it explains is no error along the scan.
        odds: how many times more probable than white noise alone errors along the scan must make the corners. Sound
            corners do so with a probability of at most one in ``odds`` (Markov's inequality).
    """

    prior_sigma: float
    process_sigma: float
    odds: float


def errors_along_scan(
    problem: BoardProblem, state: Float[Tensor, "*batch state"], doubtful: Bool[Tensor, "*batch"], known: Beforehand
) -> ErrorsAlongScan:
    """The errors along the scan for which residuals give evidence.

    Problems are looked at one by one, so that no bit of one depends on the others, and the doubtful ones alone, as each
    takes a tenth of a second.

    Args:
        state: of the problems with white noise.
        doubtful: see ``suspicious``.
    """
    rms, length = (torch.zeros_like(state[..., :3]) for _ in range(2))
    found = doubtful.clone()
    if not bool(found.any()):
        return ErrorsAlongScan(found, rms, length, None)
    rows, log_det = problem.affine_rows.clone(), problem.noise_log_det.clone()
    for index in doubtful.nonzero():
        place = tuple(index.tolist())
        one = problem.at(place)
        search = _Search.of(one, state[place], known)
        covariance = search.covariance(math.log(known.odds))
        if covariance is None:
            found[place] = False
            continue
        rms[place] = covariance.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt()
        length[place] = wave_length(covariance) * Travel.of(one).extent_mm
        noise = with_processes(one, covariance_root(covariance + search.walk))
        rows[place], log_det[place] = noise.rows, noise.log_det
    return ErrorsAlongScan(found, rms, length, CorrelatedNoise(rows, log_det) if bool(found.any()) else None)


def suspicious(problem: BoardProblem, whitened: Float[Tensor, "*batch boards corners 3"]) -> Bool[Tensor, "*batch"]:
    """Whether residuals are correlated along the travel more than chance allows.

    They are projected on half-waves over each board's travel. Of white residuals the squares, over all boards, are
    chi-square variables, and what the fit of poses and n takes makes them smaller.

    Args:
        whitened: residuals of the corners in sigmas, zero where ``valid`` is false.
    """
    travel = Travel.of(problem)
    place = (problem.points[..., 1] - travel.start_mm[..., None]) / travel.extent_mm[..., None, None]
    by_order = []
    for order in range(_ORDERS + 1):
        wave = torch.where(problem.valid, torch.cos(math.pi * order * place), 0.0)
        squares = (wave[..., None] * whitened).sum(-2).square()
        by_order.append((squares / wave.square().sum(-1).clamp(min=1.0)[..., None]).sum(-2))
    squares = torch.stack(by_order, dim=-1)
    single = chi_square_tail(squares, float(problem.boards))
    together = chi_square_tail(squares.sum(-1), float(problem.boards * (_ORDERS + 1)))
    tests = torch.cat([single.flatten(-2), together], dim=-1)
    return tests.amin(-1) * tests.shape[-1] < _SUSPICION


def with_processes(problem: BoardProblem, roots: Float[Tensor, "_ 3 knots columns"]) -> CorrelatedNoise:
    """The noise of a problem's corners and of a process per board and component, given by its root at the knots, mm.

    Args:
        problem: of batch shape ().
    """
    at_corners = Travel.of(problem).weights(problem)[:, None] @ roots
    latents = torch.zeros(*problem.points.shape, 3, roots.shape[-1], dtype=roots.dtype, device=roots.device)
    for component in range(3):
        latents[..., component, component, :] = at_corners[:, component]
    noise = rows_with_latents(
        problem.noise_chol, problem.points, problem.body_points, problem.valid, latents.flatten(-2)
    )
    return CorrelatedNoise(noise.rows, problem.noise_log_det + noise.log_det)


@dataclass
class _Search:
    """Coordinate by coordinate: the weights of all kernels of one component, the other components as they stand.

    Each component has several processes, each for what those before it leave: errors of several wavelengths.
    """

    equations: NormalEquations
    family: KernelFamily
    covariances: Float[Tensor, "3 processes knots knots"]
    by_kernel: Float[Tensor, "3 kernels"]  # log likelihood ratio to no error; that there is none has its part in it
    kept: Bool[Tensor, "3 kernels"]
    walk: Float[Tensor, "_ 1 knots knots"]  # covariance of what a walk of n explains, by board

    @classmethod
    def of(cls, problem: BoardProblem, state: Tensor, known: Beforehand) -> "_Search":
        """A search in one problem that has found nothing yet."""
        family = kernel_family().to(state)
        kernels = len(family.log_prior)
        walk = state.new_zeros(1, 1, KNOTS, KNOTS)
        if known.process_sigma:
            walk = Travel.of(problem).walk(known.process_sigma)[:, None]
        return cls(
            equations=NormalEquations.of(problem, state, known.prior_sigma),
            family=family,
            covariances=state.new_zeros(3, _PROCESSES, KNOTS, KNOTS),
            by_kernel=state.new_zeros(3, kernels),
            kept=torch.ones(3, kernels, dtype=torch.bool, device=state.device),
            walk=walk,
        )

    def covariance(self, log_odds: float) -> Tensor | None:
        """Covariance of the three components' errors at the knots, mm²; None where the evidence is below the odds."""
        alone = [self._log_ratios(component, 0, self.family) + self.family.log_prior[:, None] for component in range(3)]
        evidence = torch.logsumexp(torch.stack(alone).flatten(), 0) - math.log(3.0 * len(AMPLITUDES))
        if not bool(evidence > log_odds):
            return None
        present = [self._weigh_first(component) > _THERE for component in range(3)]
        for layer in range(1, _PROCESSES):
            for component in range(3):
                if present[component]:
                    weighed = self._weigh(component, layer, self.family, self.family.log_prior)
                    present[component] = weighed.present > _THERE
        for component in range(3):  # again, now that the other components and processes are known
            self._weigh_first(component)
        return self.covariances.sum(1)

    def _weigh_first(self, component: int) -> float:
        """Weigh the first process of a component; the probability that it is there."""
        kept = self.kept[component]
        weights = self._weigh(component, 0, self.family.chosen(kept), self._shared_prior(component)[kept])
        self.by_kernel[component, kept] = weights.by_kernel
        self.kept[component, kept.nonzero()[:, 0]] = weights.by_kernel > weights.by_kernel.max() + _FAINT
        return weights.present

    def _weigh(self, component: int, layer: int, family: KernelFamily, log_prior: Tensor) -> "_Weighed":
        """Set the covariance of one process to its mean over kernels and amplitudes."""
        ratios = self._log_ratios(component, layer, family) - math.log(len(AMPLITUDES))
        joint = ratios + log_prior[:, None] + _PRESENT
        none = torch.logsumexp(log_prior, 0) + _ABSENT
        weights = torch.exp(joint - torch.logaddexp(torch.logsumexp(joint.flatten(), 0), none))
        by_variance = (weights * self._variances(component)).sum(-1)
        self.covariances[component, layer] = torch.tensordot(by_variance, family.covariance, 1)
        by_kernel = torch.logsumexp(ratios, -1) + _PRESENT
        return _Weighed(torch.logaddexp(by_kernel, by_kernel.new_tensor(_ABSENT)), float(weights.sum()))

    def _log_ratios(self, component: int, layer: int, family: KernelFamily) -> Tensor:
        """Log likelihood ratios of a process of each kernel and amplitude to none, the others as they stand."""
        others = [other for other in range(3) if other != component]
        own = [other for other in range(_PROCESSES) if other != layer]
        standing = [*self.covariances[others].sum(1), self.covariances[component, own].sum(0)]
        roots = covariance_root(torch.stack(standing) + self.walk)
        index = torch.tensor([*others, component], device=roots.device)
        given = self.equations.given(component, index, roots)
        return self.equations.log_ratios(given, family, self._variances(component))

    def _variances(self, component: int) -> Tensor:
        """The variances to try, mm²."""
        rms = self.equations.rms_mm[component]
        return (rms * rms.new_tensor(AMPLITUDES)).square()

    def _shared_prior(self, component: int) -> Tensor:
        """Log prior of the kernels of a component, given what the other components show."""
        prior = self.family.log_prior
        others = [self.by_kernel[other] for other in range(3) if other != component]
        ratio = sum((other - torch.logsumexp(other + prior, 0) for other in others), torch.zeros_like(prior))
        return prior + torch.logaddexp(ratio + math.log(_SHARED), prior.new_tensor(math.log(1.0 - _SHARED)))


@dataclass(frozen=True)
class _Weighed:
    """Log likelihood ratio by kernel, none included, and the probability that a process is there."""

    by_kernel: Float[Tensor, " kernels"]
    present: float
