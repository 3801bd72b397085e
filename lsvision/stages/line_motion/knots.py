"""Registered lines and differences of colours, as means over equal numbers of neighbouring lines: knots.

A difference of colours spans some lines, the lag. Means over as many lines, of the displacement over those of knot j
and of the difference over those around the border to the knot before, are related by

    difference_j = (lag / lines of a knot) (δ_j - δ_(j-1)),

exactly where the lag is a whole number of lines, and to (2π / λ)² / 24 of it per squared line beside that.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD, SharedSignal
from lsvision.stages.line_motion.color_differences import ColorDifferences

_LEAST_SHARE = 0.5  # of the lines of a knot that must be measured
_LONG = 8.0  # knots, beyond which a wave is long

_CUT = 6.0  # robust standard deviations of differences, beyond which a line is none


@dataclass(frozen=True)
class Knots:
    """Means over ``size`` lines each: knot j holds the lines from ``j size`` on."""

    size: int
    count: int

    @classmethod
    def of(cls, lines: int, differences: ColorDifferences) -> "Knots":
        """Knots as long as the lag of the colours."""
        size = max(1, round(abs(differences.lag)))
        return cls(size, lines // size)

    def means(
        self, values: Float[Tensor, " lines"], valid: Bool[Tensor, " lines"], first: int = 0
    ) -> tuple[Float[Tensor, " knots"], Bool[Tensor, " knots"]]:
        """Means over the measured lines of each knot, ``first`` lines after its begin, and where there are enough."""
        line = (torch.arange(self.count * self.size) + first).view(self.count, self.size)
        inside = line.clamp(0, len(values) - 1)
        there = valid[inside] & (inside == line)
        weight = there.to(values)
        total = (weight * values[inside].nan_to_num()).sum(1)
        seen = there.sum(1) >= _LEAST_SHARE * self.size
        return total / weight.sum(1).clamp(min=1), seen

    def at_lines(self, values: Float[Tensor, " knots"], lines: int) -> Float[Tensor, " lines"]:
        """Values of lines by cubic convolution (Keys 1981) of those of the knots; constant beyond the ends."""
        place = (torch.arange(lines, dtype=values.dtype) + 0.5) / self.size - 0.5
        place = place.clamp(0, self.count - 1)
        base = place.floor()
        t = (place - base)[:, None]
        weights = torch.cat(
            [
                ((-0.5 * t + 1.0) * t - 0.5) * t,
                (1.5 * t - 2.5) * t * t + 1.0,
                ((-1.5 * t + 2.0) * t + 0.5) * t,
                (0.5 * t - 0.5) * t * t,
            ],
            dim=1,
        )
        taps = (base.long()[:, None] + torch.arange(-1, 3)).clamp(0, self.count - 1)
        return (weights * values[taps]).sum(1)


def shared_signal(
    knots: Knots,
    values: Float[Tensor, " lines"],
    valid: Bool[Tensor, " lines"],
    sigma: float,
    differences: ColorDifferences,
    component: int,
) -> SharedSignal:
    """What the profile shows of one component of the displacement, and what the colours do.

    Args:
        values: that the profile shows, where ``valid``. sigma: of means over the lines of a knot, as if white.
    """
    total, total_valid = knots.means(values, valid)
    moved = differences.values[:, component]
    measured, first = _no_outliers(moved), -round(differences.ahead) - knots.size // 2
    difference, difference_valid = knots.means(moved, measured, first)
    errors, _ = knots.means(differences.errors[:, component], measured, first)
    return SharedSignal(
        total=total,
        total_valid=total_valid,
        total_sigma=sigma,
        difference=difference - difference[difference_valid].mean().nan_to_num(),
        difference_valid=difference_valid,
        difference_sigma=_long_wave_sigma(errors[difference_valid]),
        ratio=differences.lag / knots.size,
    )


def _no_outliers(values: Float[Tensor, " lines"]) -> Bool[Tensor, " lines"]:
    """Which values are no spikes."""
    off = (values - values.nanmedian()).abs()
    return off <= _CUT * NORMAL_OVER_MAD * off.nanmedian()


def _long_wave_sigma(errors: Float[Tensor, " knots"]) -> float:
    """Standard deviation of white errors that have as much power in long waves as these.

    The median over the waves, so that one wave of something else does not count.
    """
    power = torch.fft.rfft(errors - errors.mean()).abs().square() / len(errors)
    long = power[1 : max(2, int(len(errors) / _LONG))]
    return float((long.median() / torch.log(torch.tensor(2.0))).sqrt())
