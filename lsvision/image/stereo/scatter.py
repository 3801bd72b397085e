"""Sigma of refined disparities: what least squares predict, and how much neighbouring disparities scatter.

Whatever disturbs a match, noise, a bent surface, an edge, or light that the other camera does not see, disturbs that of
a window beside it differently. So the scatter of disparities around their mean over a window is an error that has been
seen, while residuals and texture only predict one, as if each pixel had noise of its own.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.stereo.windows import Windows

# Errors over those that the scatter of independent ones would mean, on rendered pairs and photographs: errors of the
# search, which a step does not average away, scatter more than others.
_SCATTERED = 0.92
# Largest part of errors wider than a window, over that of independent ones: what looks like more is the surface's bend.
_WIDEST = 1.25
_STEP_PX = 0.8  # a larger deviation is that of another surface
# The share of the predicted variance: it covers smooth ground, which matching holds where it was, right or wrong.
_PREDICTED = 0.08
_INTERPOLATION_PX = 0.01  # what interpolation between pixels leaves at best, from the errors of rendered pairs


@dataclass(frozen=True)
class SigmaGains:
    """Factors of sigma that follow from the window of the refinement alone.

    With B the mean over a window, a step from disparities in error by e leaves ``(1 - B) B e`` of it and adds the error
    of the step. After some iterations the errors are T times those of independent pixels, and their deviations from
    the mean over a window are ``(1 - B) T`` times them.

    Args:
        iterations: sigma after all iterations over that of a single one.
        scatter: sigma over the rms deviation from the mean over a window.
        wide: variance that deviations lack, over the mean square of their own mean over a window.
    """

    iterations: float
    scatter: float
    wide: float

    @classmethod
    def of(cls, window: int, iterations: int) -> "SigmaGains":
        """Those of a square window of some blocks a side."""
        size = 8 * window * iterations
        box = torch.zeros(size, dtype=torch.float64)
        box[: window // 2 + 1] = box[size - window // 2 :] = 1.0 / window
        mean = torch.fft.fft(box).real
        mean = mean[:, None] * mean
        result = mean
        for _ in range(iterations - 1):
            result = mean + (1 - mean) * mean * result
        deviation = (1 - mean) * result
        single, final, scatter, smooth = (
            float(response.square().mean().sqrt()) for response in (mean, result, deviation, mean * deviation)
        )
        return cls(final / single, final / scatter, (final**2 - scatter**2) / smooth**2)


def with_scatter(
    predicted: Float[Tensor, "rows columns"],
    disparity: Float[Tensor, "rows columns"],
    windows: Windows,
    gains: SigmaGains,
) -> Float[Tensor, "rows columns"]:
    """Sigma of disparities, px, from the predicted one and from their scatter.

    Where a window sees two surfaces, deviations count as 0.8 px, however large the step is.

    Args:
        disparity: px, NaN outside of the windows' valid blocks.
    """
    known = torch.nan_to_num(disparity)
    deviation = windows.mean(known).sub_(known).clamp_(-_STEP_PX, _STEP_PX)
    smooth = windows.mean(deviation)
    seen = windows.mean(deviation.square_())
    wide = windows.mean(smooth.square_()).mul_(gains.wide)
    variance = torch.minimum(wide.add_(seen), seen * (_WIDEST * gains.scatter**2)).mul_(_SCATTERED**2)
    return variance.addcmul_(predicted, predicted, value=_PREDICTED).add_(_INTERPOLATION_PX**2).sqrt_()
