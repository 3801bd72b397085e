"""Whether a white reference moved: what stays in the columns of both cameras at one disparity is on the reference.

The columns of two sensors depart from each other at random. Dirt that did not move has become part of the gains of
both cameras, displaced by its disparity.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

_WINDOW, _SMOOTH = 512, 65  # columns that are compared at once; of a mean that is taken away
_SIGNIFICANT = 6.5  # standard deviations of a chance correlation, of a few thousand that are looked at


@dataclass(frozen=True)
class SharedStructure:
    """The relative rms of the structure that the gains of two cameras share, and the disparity, px."""

    rms: float
    disparity_px: int


def shared_structure(
    left: Float[Tensor, "width channels"], right: Float[Tensor, "width channels"]
) -> SharedStructure | None:
    """The largest structure that stands in both gains in some window of columns; None where chance explains all."""
    one, other = _fine(left), _fine(right)
    window = min(_WINDOW, len(one))
    size = 2 * len(other)
    found: list[SharedStructure] = []
    power = F.conv1d(other.square()[None, None], torch.ones(1, 1, window, dtype=other.dtype))[0, 0].clamp(min=1e-30)
    for start in range(0, len(one) - window + 1, window):
        part = one[start : start + window]
        product = torch.fft.irfft(torch.fft.rfft(other, size) * torch.fft.rfft(part, size).conj(), size)[: len(power)]
        correlation = product / (power * part.square().sum().clamp(min=1e-30)).sqrt()
        best = int(correlation.argmax())
        if float(correlation[best]) * window**0.5 > _SIGNIFICANT:
            shared = float(product[best].clamp(min=0) / window) ** 0.5
            found.append(SharedStructure(shared, start - best))
    return max(found, key=lambda item: item.rms, default=None)


def _fine(gain: Tensor) -> Float[Tensor, " width"]:
    """Logarithm of the gain, mean of the colours, without what changes slowly along the line."""
    logs = gain.double().log().nanmean(-1).nan_to_num()
    padded = F.pad(logs[None, None], (_SMOOTH // 2, _SMOOTH // 2), mode="replicate")
    return logs - F.avg_pool1d(padded, _SMOOTH, 1)[0, 0]
