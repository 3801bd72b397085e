"""How large the errors of registered lines are, and over how many lines they last.

Two halves of a line's columns see the same motion and err by themselves: their difference shows the errors alone, at
any lag. What a matching error has in common all over a line does not show there and is stated beforehand.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import NoisyValues
from lsvision.stages.line_motion.register import Registered

_LAGS = 100
_FORGOTTEN = 0.1  # correlation below which the sum over the lags ends
_LEAST_MEMORY, _USUAL_MEMORY = 0.3, 8.0  # lines
_LEAST_LINES = 200  # needed to estimate the memory from the differences


@dataclass(frozen=True)
class LineErrors:
    """Errors of (δx, δz, ρ) of a line.

    ``scale`` is their true size over that of independent samples, ``memory`` the lines over which they are forgotten,
    ``rms`` their size, mm and rad.
    """

    scale: Float[Tensor, "3"]
    memory: Float[Tensor, "3"]
    rms: Float[Tensor, "3"]

    @classmethod
    def of(cls, lines: Registered, data: NoisyValues, common_mm: float) -> "LineErrors":
        """Errors of lines.

        Args:
            data: the same lines with the covariance of independent samples.
            common_mm: what the depths of a line err by all together.
        """
        difference = torch.where(data.valid[:, None], lines.difference, 0.0)
        apart = difference.square().sum(0) / lines.difference_variance[data.valid].sum(0)
        stated = data.root[data.valid].square().sum(-1).mean(0)
        # Neighbouring samples err alike, which makes no error smaller than that of independent ones.
        variance = apart.clamp(min=1.0) * stated
        variance[1] += common_mm**2
        return cls((variance / stated).sqrt(), _memory(difference), variance.sqrt())


def _memory(errors: Float[Tensor, "lines 3"]) -> Float[Tensor, "3"]:
    """Memory of errors that forget exponentially and have the same sum of correlations over all lags."""
    lines = len(errors)
    if lines < _LEAST_LINES:
        return torch.full_like(errors[0], _USUAL_MEMORY)
    power = torch.fft.rfft(errors - errors.mean(0), n=2 * lines, dim=0).abs().square()
    correlation = torch.fft.irfft(power, dim=0)[: min(_LAGS, lines // 2)]
    correlation = correlation / correlation[0].clamp(min=torch.finfo(errors.dtype).tiny)
    lasting = (correlation > _FORGOTTEN).cumprod(0)
    total = 2 * (correlation * lasting).sum(0) - 1
    kept = ((total - 1) / (total + 1)).clamp(min=torch.finfo(errors.dtype).tiny)
    return (-1 / kept.log()).clamp(min=_LEAST_MEMORY)
