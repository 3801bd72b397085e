"""Displacements of single lines -> the motion from line to line: smoothed, with covariance, and only what is there.

Each component is a Gaussian process along the lines, as large, as long and as smooth as makes the lines likeliest
(``estimation.signal_fit``), with errors that are known from the lines' halves (``errors``). All components are smoothed
together, because their errors are correlated: what looks alike on a profile is split by how large each component is. A
component is corrected if the lines are much likelier with it than without, and if it exceeds the errors of a line:
slower errors of the matching look like motion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import (
    NORMAL_OVER_MAD,
    NoisyValues,
    SignalFit,
    SignalParameters,
    fit_signals,
    smooth_signals,
)
from lsvision.geometry import without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.errors import LineErrors
from lsvision.stages.line_motion.register import Registered
from lsvision.types import LINE_COMPONENTS, LineFinding, LineMotion

_LEAST_LINES = 64  # measured; with fewer, motion and errors cannot be separated
_FIT_SAMPLES, _FIT_SEQUENCES = 128, 8  # that the likelihood is taken of
_USUAL_STATES, _OTHER_STATES = 2, (1, 3)
_USUAL_LENGTH = 60.0  # lines
_SPREADS = {"sigma": 2.5, "length": 1.5, "noise_scale": 0.7, "memory": 0.7}  # of the logarithms beforehand
_EVIDENCE_STEPS = 4
_NOTHING = 1e-3  # of the errors of a line: a component that is not there
_OBSERVED = 2.0  # errors of a line over what a component usually amounts to, at most
_SPIKE_SIGMA, _SPIKE_LINES = 8.0, 9
_LINES_AT_ONCE = 4096


def not_measured(lines: int, reason: str) -> LineMotion:
    """No motion at all, because nothing could be measured."""
    findings = tuple(LineFinding(name, "not observed", reason=reason) for name in LINE_COMPONENTS[:3])
    zeros = torch.zeros(lines, 4, 4, dtype=torch.float64)
    return LineMotion(zeros[..., 0], zeros, findings)


def estimate(
    lines: Registered,
    usual_samples: int,
    along_mm: Float[Tensor, " lines"],
    errors: LineErrors,
    config: LineMotionConfig,
) -> LineMotion:
    """Motion from line to line of registered lines.

    Args:
        usual_samples: how many samples of a line take part where nothing is missing.
        along_mm: travel of the lines. errors: of single lines.
    """
    data = noisy_values(lines, usual_samples, config)
    count = len(data.values)
    needed = max(_LEAST_LINES, math.ceil(config.min_share * count))
    if int(data.valid.sum()) < needed:
        return not_measured(
            count, f"only {int(data.valid.sum())} of {count} lines show the profile, {needed} are needed"
        )
    fit = _Fit.of(data, errors, config)
    mean, covariance = smooth_signals(fit.parameters.model(), data, block=config.block_lines, halo=config.halo_lines)
    kept = fit.is_corrected(config)
    mean, covariance = _without_the_others(mean, covariance, kept)
    mean = without_trend(along_mm, data.valid)(mean.T).T
    pitch = float(along_mm.diff().abs().mean())
    shown = mean[data.valid], covariance[data.valid]
    findings = [fit.finding(i, shown[0][:, i], shown[1][:, i, i], pitch, config) for i in range(3)]
    return LineMotion(pad(mean, (0, 1)), pad(covariance, (0, 1, 0, 1)), tuple(findings))


def _without_the_others(mean: Tensor, covariance: Tensor, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Means of the components that are corrected where the others are zero, and second moments of what all err then.

    Not correcting a component moves the others by what they share: a small roll left in place of a rail beside the
    pivot is a displacement in depth, and the profile shows their sum.
    """
    if not bool(kept.any()):
        return torch.zeros_like(mean), torch.zeros_like(covariance)
    other = ~kept
    among, across = covariance[:, other][:, :, other], covariance[:, kept][:, :, other]
    left = mean * other
    left[:, kept] = (across @ torch.linalg.solve(among, mean[:, other, None]))[..., 0]
    return (mean - left) * kept, covariance + left[:, :, None] * left[:, None]


def noisy_values(lines: Registered, usual_samples: int, config: LineMotionConfig) -> NoisyValues:
    """Values of lines, measured where enough samples of the object took part and the line is no spike among others."""
    root = torch.linalg.cholesky(lines.covariance)
    valid = (lines.samples >= max(1.0, config.min_share * usual_samples)) & lines.values.isfinite().all(1)
    values = torch.where(valid[:, None], lines.values, torch.nan)
    values = values - values.nanmedian(0).values.nan_to_num()
    valid &= ~(values[:, 1].abs() > config.largest_mm)  # another object
    half = _SPIKE_LINES // 2
    around = torch.cat([values[:1].expand(half, -1), values, values[-1:].expand(half, -1)]).unfold(0, _SPIKE_LINES, 1)
    medians = [some.nanmedian(-1).values for some in around.split(_LINES_AT_ONCE)]
    off = (values - torch.cat(medians)).abs()
    usual = (NORMAL_OVER_MAD * off.nanmedian(0).values).nan_to_num()  # due to the motion itself and correlated errors
    valid &= ~(off > _SPIKE_SIGMA * root.square().sum(-1).sqrt().maximum(usual)).any(1)
    return NoisyValues(torch.where(valid[:, None], values, 0.0), root, valid)


@dataclass(frozen=True)
class _Fit:
    """The likeliest processes, how much each component adds to the likelihood, and the errors of a line, rms."""

    parameters: SignalParameters
    evidence: Sequence[float]
    noise: Float[Tensor, " signals"]

    @classmethod
    def of(cls, data: NoisyValues, errors: LineErrors, config: LineMotionConfig) -> "_Fit":
        """Fit the processes to lines with known errors."""
        stride, sequences = _thinned(data, errors)
        spread = (data.values[data.valid].square().mean(0) - errors.rms.square()).clamp(min=0).sqrt()
        expected, observed = _expected(config), _observed(errors.rms, config)
        usual = SignalParameters(
            _USUAL_STATES, expected, torch.full_like(expected, _USUAL_LENGTH), errors.scale, errors.memory
        ).thinned(float(stride))
        log_prior, signals = _Prior(usual), len(expected)
        # What the lines do not show is as large as usual.
        free = torch.stack([observed, observed, observed & False, observed & False]).to(expected)
        start = replace(usual, sigma=torch.where(observed, spread.maximum(expected / 2), expected))
        fit = fit_signals(start, sequences, log_prior, free.flatten(), iterations=8)
        for states in _OTHER_STATES:
            other = fit_signals(
                replace(fit.parameters, states=states), sequences, log_prior, free.flatten(), iterations=3
            )
            fit = other if other.log_density > fit.log_density else fit
        evidence = [
            fit.log_density - _without(fit, i, errors.rms, start.sigma, free, sequences, log_prior)
            if observed[i] and fit.parameters.sigma[i] > config.least_ratio * errors.rms[i]
            else 0.0
            for i in range(signals)
        ]
        return cls(fit.parameters.thinned(1 / stride), evidence, errors.rms)

    def is_corrected(self, config: LineMotionConfig) -> Bool[Tensor, " signals"]:
        """Which components are observed, likely and larger than the errors of a line."""
        likely = self.noise.new_tensor(self.evidence) > config.evidence
        return _observed(self.noise, config) & likely & (self.parameters.sigma > config.least_ratio * self.noise)

    def finding(
        self, index: int, mean: Tensor, variance: Tensor, pitch_mm: float, config: LineMotionConfig
    ) -> LineFinding:
        """What is known about a component, from its smoothed values."""
        name, noise, rms = LINE_COMPONENTS[index], float(self.noise[index]), float(_rms(mean))
        if not _observed(self.noise, config)[index]:
            return LineFinding(name, "not observed", sigma=noise)
        if self.is_corrected(config)[index]:
            length = float(self.parameters.length[index]) * pitch_mm
            return LineFinding(name, "corrected", rms, float(variance.mean().sqrt()), length, self.evidence[index])
        return LineFinding(name, "absent", sigma=noise, evidence=self.evidence[index])


@dataclass(frozen=True)
class _Prior:
    """Log-normal prior of all parameters about usual ones: wide, but none runs away that the data leave open."""

    usual: SignalParameters

    def __call__(self, parameters: SignalParameters) -> Float[Tensor, " candidates"]:
        """Logarithm of the density of candidates."""
        total = parameters.memory.new_zeros(len(parameters.memory))
        for name, spread in _SPREADS.items():
            off = (getattr(parameters, name).log() - getattr(self.usual, name).log()) / spread
            total = total - off.square().reshape(len(total), -1).sum(-1) / 2
        return total


def _without(
    fit: SignalFit,
    index: int,
    noise: Tensor,
    large: Tensor,
    free: Tensor,
    sequences: NoisyValues,
    log_prior: _Prior,
) -> float:
    """Logarithm of the density where one component is not there, and its noise and the others explain what they can.

    Args:
        noise: of a line. large: sigmas from which the others start.
    """
    sigma = large.maximum(fit.parameters.sigma)
    sigma[index] = _NOTHING * noise[index]
    free = free.clone()
    free[:, index] = free.new_tensor([0.0, 0.0, 1.0, 1.0])
    scale = fit.parameters.noise_scale.clone()
    scale[index] *= torch.hypot(noise[index], large[index]) / noise[index]
    start = replace(fit.parameters, sigma=sigma, noise_scale=scale)
    found = fit_signals(start, sequences, log_prior, free.flatten(), iterations=_EVIDENCE_STEPS)
    # That the prior finds a sigma of nothing unlikely is no evidence.
    back = replace(found.parameters, sigma=fit.parameters.sigma)
    return found.log_density - float(log_prior(_as_batch(found.parameters)) - log_prior(_as_batch(back)))


def _expected(config: LineMotionConfig) -> Float[Tensor, "3"]:
    """What each component usually amounts to, mm and rad."""
    roll = math.radians(config.expected_roll_deg)
    return torch.tensor([config.expected_x_mm, config.expected_z_mm, roll], dtype=torch.float64)


def _observed(noise: Float[Tensor, "3"], config: LineMotionConfig) -> Bool[Tensor, "3"]:
    """Of which components the error of a line is at most twice what they usually amount to."""
    return noise <= _OBSERVED * _expected(config)


def _as_batch(parameters: SignalParameters) -> SignalParameters:
    return parameters.at(parameters.logarithms()[None])


def _thinned(data: NoisyValues, errors: LineErrors) -> tuple[int, NoisyValues]:
    """Sequences from all over the lines for the likelihood: lines as far apart as their errors are remembered."""
    count = len(data.values)
    stride = max(1, min(int(errors.memory.min()), count // _LEAST_LINES))
    sequences = min(_FIT_SEQUENCES, -(-count // (_FIT_SAMPLES * stride)))
    span = min(_FIT_SAMPLES * stride, count // sequences)
    starts = [i * (count - span) // max(sequences - 1, 1) for i in range(sequences)]
    return stride, data.at(torch.arange(0, span, stride)[:, None] + torch.tensor(starts))


def _rms(values: Tensor) -> Tensor:
    """Root mean square over the lines."""
    return values.square().mean(0).sqrt()
