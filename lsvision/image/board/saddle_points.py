"""Saddle points of an image: candidates for the corners of a checkerboard, to the nearest pixel."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

_BLUR_PX = 1.5
_PEAK_PX = 7  # saddles lie further apart
_FAINTEST = 0.1  # response of a saddle over the median response of as many saddles as the board has corners


@dataclass(frozen=True)
class SaddlePoints:
    """Saddle points of an image, strongest first, float64.

    ``curvature`` is the Hessian of the brightness as (xx, xy, yy) of length 1. ``evenness`` is minus its determinant
    over the variance around the point, 1/px⁴: it depends neither on the light nor on the contrast.
    """

    points: Float[Tensor, "saddles 2"]
    curvature: Float[Tensor, "saddles 3"]
    evenness: Float[Tensor, " saddles"]

    def of(self, chosen: Bool[Tensor, " saddles"]) -> "SaddlePoints":
        """Some of the points."""
        return SaddlePoints(self.points[chosen], self.curvature[chosen], self.evenness[chosen])

    def alignment(self, index: int) -> Float[Tensor, " saddles"]:
        """How alike in orientation all are to one: 1 is the same, -1 has bright and dark swapped."""
        # Of (xx, xy, yy) the mixed derivative stands in the Hessian twice.
        product = (self.curvature * self.curvature[index] * self.curvature.new_tensor([1.0, 2.0, 1.0])).sum(-1)
        return product / product[index]


def find_saddle_points(brightness: Float[Tensor, "lines width"], most: int, expected: int) -> SaddlePoints:
    """The strongest saddle points of an image, none fainter than a tenth of the median of the expected corners.

    Args:
        most: largest number of points.
        expected: number of strongest points that are probably corners.
    """
    # Takes a second to import and is needed for few images.
    from kornia.filters import gaussian_blur2d, spatial_gradient

    smooth = gaussian_blur2d((brightness - brightness.mean())[None, None], (9, 9), (_BLUR_PX, _BLUR_PX))
    xx, xy, yy = spatial_gradient(smooth, mode="diff", order=2)[0, 0]
    # Minus the determinant of the Hessian is positive at saddles alone.
    # kornia's hessian_response is equal to the bit but keeps no derivatives: 70 ms more on 900 x 900 px.
    response = (xy * xy - xx * yy).clamp(min=0)
    line, column = _strongest_peaks(response, most, expected).unbind(-1)
    curvature = torch.stack([field[line, column] for field in (xx, xy, yy)], dim=-1).double()
    variance = _local_variance(smooth)[line, column].double()
    evenness = response[line, column].double() / variance.clamp(min=1e-6)
    return SaddlePoints(torch.stack([column, line], dim=-1).double(), F.normalize(curvature, dim=-1), evenness)


def _strongest_peaks(response: Tensor, most: int, expected: int) -> Tensor:
    """Places (peaks, 2) as (line, column) of the largest local maxima, largest first."""
    peak = F.max_pool2d(response[None], _PEAK_PX, 1, _PEAK_PX // 2)[0]
    found = ((response == peak) & (response > 0)).nonzero()
    strength, order = response[found[:, 0], found[:, 1]].sort(descending=True)
    strong = strength[:most] > _FAINTEST * strength[:expected].median()
    return found[order[:most][strong]]


def _local_variance(smooth: Tensor) -> Tensor:
    """Variance (lines, width) of an image (1, 1, lines, width) in windows of the size of a saddle."""
    mean, power = F.avg_pool2d(torch.cat([smooth, smooth * smooth]), _PEAK_PX, 1, _PEAK_PX // 2)[:, 0]
    return power - mean * mean
