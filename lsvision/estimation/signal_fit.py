"""How large and how long the signals of noisy values are, and how their noise is: by the marginal likelihood.

The likelihood of a sequence is that of its innovations, which one pass of the filter gives for a whole batch of
candidates. Its maximum over the logarithms of all parameters is found by Newton steps along each of them at once, with
the curvature from the same batch.

Source: Schweppe 1965 (innovation form); Särkkä & Svensson 2023, ch. 16.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.signals import NoisyValues, SignalModel, log_likelihood_of
from lsvision.estimation.state_space_process import matern

_FIRST_STEP = 0.7  # of the logarithms: a factor of two
_LAST_STEP = 0.05
_LONGEST_MOVE = 2.0  # steps
_LEAST_BEND = 1e-2  # a density flatter than that asks for the longest move
_LEAST_GAIN = 0.02  # of the density's logarithm, below which nothing more is to be had


@dataclass(frozen=True)
class SignalParameters:
    """Matérn processes of the signals, and their noise; lengths in samples.

    Attributes:
        states: of each process: 1, 2 or 3 for smoothness 1/2, 3/2, 5/2.
        sigma: standard deviation of each signal. length: of its kernel.
        noise_scale: true over stated noise of each signal. memory: of its noise, -1 / ln φ.
    """

    states: int
    sigma: Float[Tensor, "*batch signals"]
    length: Float[Tensor, "*batch signals"]
    noise_scale: Float[Tensor, "*batch signals"]
    memory: Float[Tensor, "*batch signals"]

    def model(self) -> SignalModel:
        """The model for filter and smoother.

        A signal lasts longer than the noise's memory: a shorter one looks like noise and counts as noise.
        """
        length = self.length.maximum(2 * self.memory)
        processes = [
            matern(self.states, sigma, span)
            for sigma, span in zip(self.sigma.unbind(-1), length.unbind(-1), strict=True)
        ]
        return SignalModel(processes, torch.exp(-1 / self.memory), self.noise_scale)

    def logarithms(self) -> Float[Tensor, "*batch parameters"]:
        """All numbers as one vector of logarithms."""
        return torch.cat([self.sigma, self.length, self.noise_scale, self.memory], -1).log()

    def at(self, logarithms: Float[Tensor, "*batch parameters"]) -> "SignalParameters":
        """The same kind of processes with other numbers."""
        signals = self.sigma.shape[-1]
        sigma, length, scale, memory = logarithms.exp().split(signals, -1)
        return replace(self, sigma=sigma, length=length, noise_scale=scale, memory=memory)

    def thinned(self, stride: float) -> "SignalParameters":
        """For every ``stride``-th sample; 1 / stride takes it back."""
        return replace(self, length=self.length / stride, memory=self.memory / stride)


@dataclass(frozen=True)
class SignalFit:
    """Parameters of the greatest posterior density, and the logarithm of the density there (up to a constant)."""

    parameters: SignalParameters
    log_density: float


def log_likelihood(parameters: SignalParameters, data: NoisyValues) -> Float[Tensor, " candidates"]:
    """Logarithm of the likelihood of every candidate.

    Args:
        parameters: ``(candidates, ..)``. data: independent sequences side by side, ``(samples, sequences, ..)``.
    """
    candidates = len(parameters.sigma)

    def spread(part: Tensor) -> Tensor:
        """With a dimension for the candidates."""
        return part[:, None].expand(-1, candidates, *part.shape[1:])

    model = parameters.at(parameters.logarithms()[:, None]).model()
    spread_data = NoisyValues(spread(data.values), spread(data.root), spread(data.valid))
    return log_likelihood_of(model, spread_data).sum(-1)


def fit_signals(
    start: SignalParameters,
    data: NoisyValues,
    log_prior: Callable[[SignalParameters], Float[Tensor, " candidates"]],
    free: Float[Tensor, " parameters"] | None = None,
    iterations: int = 8,
) -> SignalFit:
    """Parameters of the greatest posterior density.

    Args:
        start: without a batch. data: independent sequences side by side, ``(samples, sequences, ..)``.
        log_prior: logarithm of the prior density of candidates.
        free: one where a parameter, in the order of ``logarithms``, is looked for, zero where it keeps its value.
    """
    point = start.logarithms()
    free = torch.ones_like(point) if free is None else free
    which = free.nonzero()[:, 0]
    axes = torch.eye(len(point), dtype=point.dtype, device=point.device)[which]
    step = torch.full_like(point[which], _FIRST_STEP)
    move, best = torch.zeros_like(point), -torch.inf
    for _ in range(iterations):
        # The last move in full, by half and not at all; around the full one, a step along each axis.
        tried, around = torch.stack([point + move, point + move / 2, point]), step[:, None] * axes
        candidates = torch.cat([tried, tried[:1] + around, tried[:1] - around])
        density = _density(start, candidates, data, log_prior).nan_to_num(-torch.inf, neginf=-torch.inf)
        plus, minus = density[3 : 3 + len(step)], density[3 + len(step) :]
        bend = (plus + minus - 2 * density[0]).clamp(max=-_LEAST_BEND)
        newton = ((minus - plus) / 2 / bend).clamp(-_LONGEST_MOVE, _LONGEST_MOVE) * step
        winner = int(density.argmax())
        gain, best = float(density[winner]) - best, float(density[winner])
        point = candidates[winner]
        trusted = bool(density[0] >= density[1:3].max())
        move = candidates[0] + newton @ axes - point if trusted else torch.zeros_like(point)
        if trusted and gain < _LEAST_GAIN:
            break
        # About as wide as the density; shorter where the last move went too far.
        step = (step * (-1 / bend).sqrt()).clamp(_LAST_STEP, _FIRST_STEP) if trusted else step / 2
    return SignalFit(start.at(point), best)


def _density(
    start: SignalParameters, candidates: Tensor, data: NoisyValues, log_prior: Callable[[SignalParameters], Tensor]
) -> Tensor:
    parameters = start.at(candidates)
    return log_likelihood(parameters, data) + log_prior(parameters)
