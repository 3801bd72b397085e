"""The variances and frequencies of errors along the scan as unknowns: how well they are known, and what n owes them.

The covariance of n under given variances and frequencies is that of n alone. These are known no better than the data
show: n moves with them, and the covariance of n under those that are most probable is too small by as much again in
the mean. Both are allowed for.

Source: Kackar & Harville 1984; Kenward & Roger 1997, Small Sample Inference for Fixed Effects from Restricted Maximum
Likelihood.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.stages.calibration.along_scan.evidence import NormalEquations
from lsvision.stages.calibration.along_scan.kernels import FINE, kernel_family
from lsvision.stages.calibration.along_scan.projected import Projected
from lsvision.stages.calibration.along_scan.search import evidence_of
from lsvision.stages.calibration.along_scan.spectrum import Spectrum, wave_correlations, wave_slopes

# Of a component's variance, and of the largest one's: kernels and waves of less have no part in anything.
_ACTIVE, _ACTIVE_AT_ALL = 1e-4, 1e-6
_LOG_SIGMA, _FREQUENCY_SIGMA = 2.0, 3.0  # of the logarithms of variances, and of frequencies, beforehand
_FARTHEST_LOG, _FARTHEST = 2.0, 0.05  # that a step goes in either
_LEAST, _MOST = 0.25, 9.0  # waves per unit: longer ones are a motion n, shorter ones fall between the knots
_DAMPED, _LEAST_DAMPED = 1e-2, 1e-6
_SETTLED = 0.02  # nats


def usual_variance(equations: NormalEquations) -> Float[Tensor, "4 1"]:
    """The mean of a variance beforehand, mm²: that of the residuals."""
    return equations.rms_mm.square()[:, None].clamp(min=1e-12)


def correlations(spectrum: Spectrum) -> Float[Tensor, "kernels_and_waves knots knots"]:
    """Those of all kernels and waves at the fine knots."""
    family = kernel_family(FINE).covariance.to(spectrum.variances)
    return torch.cat([family, wave_correlations(spectrum.frequency, FINE)])


def log_posterior(equations: NormalEquations, spectrum: Spectrum) -> float:
    """Log of the restricted likelihood and of the variances' prior, up to a constant."""
    variances = torch.cat([spectrum.variances, spectrum.of_waves], dim=-1)
    return evidence_of(equations, spectrum.covariance(FINE)) - float((variances / usual_variance(equations)).sum())


def log_probability(equations: NormalEquations, spectrum: Spectrum, choices: int) -> float:
    """Log evidence for a kind of spectrum whose kernels are chosen among some, up to a constant, by Laplace's method.

    Of each direction in which the data know the parameters, the prior had room for √(1 + λ) as many, λ the information
    over the prior's, and chose one of the kernels.
    """
    scores = Scores.of(equations, spectrum)
    root = scores.beforehand.rsqrt()
    known = torch.linalg.eigvalsh(root[:, None] * scores.information * root).clamp(min=0.0)
    chosen = float((known / (1.0 + known)).sum()) * math.log(choices)
    return evidence_of(equations, spectrum.covariance(FINE)) - 0.5 * float(known.log1p().sum()) - chosen


@dataclass(frozen=True)
class Scores:
    """Gradient and expected information of the log posterior by the logarithms of ``active`` variances, by frequencies.

    ``active`` are the components and kernels, waves after kernels; ``of_shared`` is the change of n, and of what else
    all boards share, by each parameter.
    """

    gradient: Float[Tensor, " parameters"]
    information: Float[Tensor, "parameters parameters"]
    of_shared: Float[Tensor, "shared parameters"]
    active: Int[Tensor, "active 2"]

    @classmethod
    def of(cls, equations: NormalEquations, spectrum: Spectrum) -> "Scores":
        """Those at a spectrum of one problem."""
        slopes = _Slopes.of(spectrum)
        data = Projected.of(equations, spectrum.covariance(FINE))
        alpha, component = data.weighed[:, slopes.component], slopes.component
        shown = torch.einsum("bsi,sij,bsj->s", alpha, slopes.slope, alpha)
        expected = torch.einsum("sij,bsji->s", slopes.slope, data.own[:, component])
        moved = -torch.einsum("bnsk,skl,bsl->ns", data.of_shared[:, :, component], slopes.slope, alpha)
        together = slopes.parameter[:, None] == torch.arange(slopes.count)
        sum_of = together.to(alpha)
        gradient = sum_of.mT @ (0.5 * (shown - expected))
        information = sum_of.mT @ _information(data, slopes) @ sum_of
        by_prior = (_all_variances(spectrum) / usual_variance(equations))[tuple(slopes.active.mT)]
        gradient[: len(by_prior)] -= by_prior
        information[: len(by_prior), : len(by_prior)] += torch.diag(by_prior)
        return cls(gradient, information, moved @ sum_of, slopes.active)

    @property
    def beforehand(self) -> Float[Tensor, " parameters"]:
        """The prior's information on each parameter."""
        information = torch.full_like(self.gradient, _FREQUENCY_SIGMA**-2)
        information[: len(self.active)] = _LOG_SIGMA**-2
        return information

    @property
    def covariance(self) -> Float[Tensor, "parameters parameters"]:
        """Covariance of the parameters."""
        return torch.linalg.inv(self.information + torch.diag(self.beforehand))

    @property
    def frequency_sigma(self) -> Float[Tensor, " waves"]:
        """Sigma of each frequency, waves per unit."""
        return self.covariance.diagonal()[len(self.active) :].sqrt()

    @property
    def factor_of_shared(self) -> Float[Tensor, "shared shared"]:
        """Factor of what the covariance of n, and of what else is shared, owes to the parameters: see the module."""
        covariance = 2.0 * self.of_shared @ self.covariance @ self.of_shared.mT
        values, vectors = torch.linalg.eigh((covariance + covariance.mT) / 2)
        return vectors * values.clamp(min=0.0).sqrt()


def climbed(equations: NormalEquations, spectrum: Spectrum, steps: int) -> Spectrum:
    """A spectrum whose posterior is greatest nearby: by scoring, its steps damped where they go too far."""
    damping, value, scores = _DAMPED, log_posterior(equations, spectrum), Scores.of(equations, spectrum)
    for _ in range(steps):
        curvature = scores.information + damping * torch.diag(scores.information.diagonal().clamp(min=1e-9))
        step = torch.linalg.solve(curvature, scores.gradient)
        trial = moved(spectrum, scores.active, step)
        reached = log_posterior(equations, trial)
        if not reached >= value:
            damping = max(10.0 * damping, _DAMPED)
            continue
        spectrum, value, damping = trial, reached, max(damping / 10.0, _LEAST_DAMPED)
        if float(step @ scores.gradient) < _SETTLED:
            break
        scores = Scores.of(equations, spectrum)
    return spectrum


def moved(spectrum: Spectrum, active: Int[Tensor, "active 2"], step: Float[Tensor, " parameters"]) -> Spectrum:
    """A spectrum after a step of its parameters."""
    both, kernels = _all_variances(spectrum), spectrum.variances.shape[-1]
    place = tuple(active.mT)
    both[place] = both[place] * step[: len(active)].clamp(-_FARTHEST_LOG, _FARTHEST_LOG).exp()
    frequency = spectrum.frequency + step[len(active) :].clamp(-_FARTHEST, _FARTHEST)
    return Spectrum(both[:, :kernels], frequency.clamp(_LEAST, _MOST), both[:, kernels:])


def _all_variances(spectrum: Spectrum) -> Float[Tensor, "4 kernels_and_waves"]:
    return torch.cat([spectrum.variances, spectrum.of_waves], dim=-1)


@dataclass(frozen=True)
class _Slopes:
    """Derivatives of the covariance of one ``component`` each by a ``parameter``; a frequency has one per component."""

    slope: Float[Tensor, "slopes knots knots"]
    component: Int[Tensor, " slopes"]
    parameter: Int[Tensor, " slopes"]
    active: Int[Tensor, "active 2"]
    count: int

    @classmethod
    def of(cls, spectrum: Spectrum) -> "_Slopes":
        """Those by the logarithms of the variances that matter, and by the frequencies of the waves."""
        both, waves = _all_variances(spectrum), spectrum.waves
        total = both.sum(-1, keepdim=True)
        active = (both > torch.maximum(_ACTIVE * total, _ACTIVE_AT_ALL * total.amax())).nonzero()
        by_variance = both[tuple(active.mT)][:, None, None] * correlations(spectrum)[active[:, 1]]
        by_frequency = spectrum.of_waves[..., None, None] * wave_slopes(spectrum.frequency, FINE)
        wave = torch.arange(waves, device=active.device)
        component = torch.arange(len(both), device=active.device)
        return cls(
            slope=torch.cat([by_variance, by_frequency.flatten(0, 1)]),
            component=torch.cat([active[:, 0], component.repeat_interleave(waves)]),
            parameter=torch.cat([torch.arange(len(active)), len(active) + wave.repeat(len(both))]),
            active=active,
            count=len(active) + waves,
        )


def _information(data: Projected, slopes: _Slopes) -> Float[Tensor, "slopes slopes"]:
    """Expected information of the slopes' parameters, each alone."""
    components, count = data.weighed.shape[1], len(slopes.slope)
    precision = data.precision
    information = data.weighed.new_zeros(count, count)
    of = [(slopes.component == component).nonzero()[:, 0] for component in range(components)]
    for c in range(components):
        for d in range(c, components):
            left = precision[:, d, :, c][:, None] @ slopes.slope[of[c]]
            right = left if c == d else precision[:, c, :, d][:, None] @ slopes.slope[of[d]]
            part = 0.5 * left.movedim(0, 1).flatten(1) @ right.mT.movedim(0, 1).flatten(1).mT
            information[of[c][:, None], of[d]] = part
            information[of[d][:, None], of[c]] = part.mT
    return information
