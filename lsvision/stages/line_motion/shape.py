"""What of a measured motion is the object's own shape along its travel, and stays in the height.

A profile shows δ(v) + s(v), the displacement of the object and its shape: corrugation, bow, twist. Two things
separate them: a stated prior, that waves longer than ``shape_longer_than_mm`` are shape, and the colours of a trilinear
sensor, which see differences of δ alone (``color_differences``). What neither separates is taken for motion.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import SharedFit, SharedSignal, fit_shares, smooth_shares
from lsvision.geometry import without_trend
from lsvision.stages.line_motion.color_differences import ColorDifferences
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.errors import LineErrors
from lsvision.stages.line_motion.knots import Knots, shared_signal
from lsvision.stages.line_motion.register import Registered
from lsvision.types import LineFinding, LineMotion

_USUAL_LENGTH_MM = 20.0
_BLOCK_KNOTS, _HALO_KNOTS = 512, 512
_LEAST_KNOTS = 32
_SEPARATED = 0.25  # error of a wave's amplitude over the rms of all, with which shape and motion are separated
_FEWEST_WAVES = 4.0  # of a scan: of fewer, one is not separated from another
_DOUBT = 3.0  # evidence for a shape, too little to find it, from which on nothing counts as separated
_ORDER = 4  # of the Butterworth filter that splits waves by length


@dataclass(frozen=True)
class ShapeData:
    """What the split of a motion into displacement and shape needs to know of its lines.

    Attributes:
        lines: as registered, and ``valid`` which of them count. along_mm: their travel. errors: of them.
        differences: of the colours; None where all look at one line.
    """

    lines: Registered
    valid: Bool[Tensor, " lines"]
    along_mm: Float[Tensor, " lines"]
    errors: LineErrors
    differences: ColorDifferences | None

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbouring lines."""
        return float(self.along_mm.diff().abs().mean())

    def knot_sigma(self, index: int, lines: int) -> float:
        """Errors of means over some neighbouring lines, as large as white ones with as much power in long waves."""
        kept = math.exp(-1 / float(self.errors.memory[index]))
        return float(self.errors.rms[index]) * math.sqrt((1 + kept) / (1 - kept) / lines)


def without_shape(motion: LineMotion, data: ShapeData, config: LineMotionConfig) -> LineMotion:
    """The motion less what of it is the object's shape, with findings that say so."""
    values, covariance, findings = motion.values.clone(), motion.covariance.clone(), list(motion.findings)
    for index, finding in enumerate(findings):
        if finding.state != "corrected":
            continue
        shape = _shape_of(values[:, index], index, data, finding, config)
        gauged = without_trend(data.along_mm, data.valid)(shape.mean)
        values[:, index] -= gauged
        covariance[:, index, index] += shape.variance
        findings[index] = _finding_with(finding, values[:, index], gauged, shape)
        if findings[index].state == "absent":
            values[:, index] = 0.0
            covariance[:, index] = covariance[:, :, index] = 0.0
    return LineMotion(values, covariance, tuple(findings))


@dataclass(frozen=True)
class _Shape:
    """Shape by line and its variance, up to which wavelength the colours show it, and whether it is all there is."""

    mean: Float[Tensor, " lines"]
    variance: Float[Tensor, " lines"]
    separated_up_to_mm: float | None = None
    is_all: bool = False


def _shape_of(
    values: Float[Tensor, " lines"], index: int, data: ShapeData, finding: LineFinding, config: LineMotionConfig
) -> _Shape:
    """Shape among the values of a component: its long waves by the prior, and what the colours show of the others."""
    shape = _Shape(torch.zeros_like(values), torch.zeros_like(values))
    if config.shape_longer_than_mm is not None:
        shape = replace(shape, mean=longer_waves(values, data.pitch_mm, config.shape_longer_than_mm))
    if data.differences is None:
        return shape
    knots = Knots.of(len(values), data.differences)
    if knots.count < _LEAST_KNOTS:
        return shape
    left, sigma = data.lines.values[:, index] - shape.mean, data.knot_sigma(index, knots.size)
    signal = shared_signal(knots, left, data.valid, sigma, data.differences, index)
    return _with_colors(shape, knots, signal, data.pitch_mm, config)


def _with_colors(
    shape: _Shape, knots: Knots, signal: SharedSignal, pitch_mm: float, config: LineMotionConfig
) -> _Shape:
    """The shape with what the colours add to it."""
    rms = float(signal.total[signal.total_valid].std())
    fit = fit_shares(signal, rms, _USUAL_LENGTH_MM / (knots.size * pitch_mm))
    shape = replace(shape, separated_up_to_mm=separated_up_to_mm(signal, knots, rms, pitch_mm))
    there = _is_there(fit, 1, signal, config)
    if there and not _is_there(fit, 0, signal, config):
        return replace(shape, is_all=True)
    if not there and fit.evidence[1] < _DOUBT and not fit.neighbours:
        return shape
    mean, variance = (
        knots.at_lines(part, len(shape.mean))
        for part in smooth_shares(fit.model, signal, block=_BLOCK_KNOTS, halo=_HALO_KNOTS)
    )
    variance = variance.clamp(min=0)
    if not there:  # in doubt: what may be shape is taken for motion, and its sigma says so
        return replace(shape, separated_up_to_mm=None, variance=mean.square() + variance)
    return replace(shape, mean=shape.mean + mean, variance=variance)


def _is_there(fit: SharedFit, which: int, signal: SharedSignal, config: LineMotionConfig) -> bool:
    """Whether displacement (0) or shape (1) is there: the data ask for it, and it exceeds the errors."""
    large = fit.sigma(which) > config.least_ratio * signal.total_sigma
    return fit.evidence[which] > config.evidence and large


def separated_up_to_mm(signal: SharedSignal, knots: Knots, rms: float, pitch_mm: float) -> float | None:
    """Longest wavelength at which the colours separate a wave of the whole scan from shape; None where at none.

    A difference shows a wave of length λ, in knots, times 2 r sin(π / λ).
    """
    error = signal.difference_sigma * math.sqrt(2 / max(int(signal.difference_valid.sum()), 1))
    needed = error / max(2 * abs(signal.ratio) * _SEPARATED * rms, 1e-12)
    if needed >= 1:
        return None
    return min(math.pi / math.asin(needed), knots.count / _FEWEST_WAVES) * knots.size * pitch_mm


def longer_waves(values: Float[Tensor, " lines"], pitch_mm: float, longest_mm: float) -> Float[Tensor, " lines"]:
    """Waves longer than a wavelength: a Butterworth filter of zero phase, of which half is left at that wavelength.

    Beyond either end the values go on turned about it, so that a trend stays one.
    """
    before, after = 2 * values[0] - values.flip(0)[:-1], 2 * values[-1] - values.flip(0)[1:]
    whole = torch.cat([before, values, after])
    frequency = torch.fft.rfftfreq(len(whole), pitch_mm, dtype=values.dtype)
    passed = torch.fft.rfft(whole) / (1 + (frequency * longest_mm) ** (2 * _ORDER))
    return torch.fft.irfft(passed, n=len(whole))[len(before) : len(before) + len(values)]


def _finding_with(finding: LineFinding, values: Tensor, shape: Tensor, of: _Shape) -> LineFinding:
    """What is known of a component whose shape was removed."""
    finding = replace(finding, separated_up_to_mm=of.separated_up_to_mm)
    if of.is_all or _rms(values) <= finding.sigma:
        return replace(finding, state="absent", rms=0.0, length_mm=None, shape_rms=finding.rms)
    finding = replace(finding, sigma=math.hypot(finding.sigma, float(of.variance.mean().sqrt())))
    return replace(finding, rms=_rms(values), shape_rms=_rms(shape)) if bool(shape.any()) else finding


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
