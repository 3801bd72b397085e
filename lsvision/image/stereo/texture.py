"""What the texture of a window proves about its centre, and what it leaves open.

In noise alone a window fits its partner somewhere, and beside a strong edge a window without texture of its own fits by
the edge: both look like good matches. A match is proven where slopes exceed those of noise. Where the texture lies
aside of the centre, the centre's disparity is known less well than that of the texture.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.stereo.differences import second_difference
from lsvision.image.stereo.shift import SLOPE_NOISE, LeftWindows
from lsvision.image.stereo.windows import window_sum

_CURVATURE_NOISE = 0.5 / 6.0  # variance of half the difference of two neighbours over that of a second difference
# Squared standard deviation of the mean of n squared slopes of white noise, times n and over the squared mean: 2, and 1
# since slopes two pixels apart share a pixel; and that of the mean of n squared residuals.
_SPREAD = 3.0 + 2.0
_TEXTURED = 3.0  # times the noise
# Change of the disparity that the search may have missed, px a px, where nothing around the texture has texture: by
# it the disparity of a centre may differ from that of a texture aside of it.
_MISSED_SLOPE = 0.07


@dataclass(frozen=True)
class TextureSupport:
    """What the texture of windows says about their centres.

    Attributes:
        proven: whether a window of 1.5 times the size has texture beyond noise.
        variance: of the centre's disparity that texture aside of it leaves, px².
    """

    proven: Bool[Tensor, "rows columns"]
    variance: Float[Tensor, "rows columns"]


def texture_support(
    equations: LeftWindows, residual_variance: Float[Tensor, "rows columns"], confidence: float
) -> TextureSupport:
    """Compare the slopes in windows with those of noise alone, and find where in the windows they lie.

    The noise is the lesser of two: what the match leaves in the window, which a mismatch makes too large, and what the
    window's second differences could be, which fine texture makes too large. The given one is not asked: that of dark
    scans is far larger.

    Args:
        equations: of the left image and its windows.
        residual_variance: of the grey values that the match leaves in each window.
        confidence: by how many standard deviations the slopes must exceed noise.
    """
    windows, block = equations.windows, equations.block
    size = 2 * (3 * (windows.size // 2) // 2) + 1
    count = window_sum(windows.weight, size).clamp_(min=0.5)

    def mean(values: Tensor) -> Tensor:
        return window_sum(values * windows.weight, size).div_(count)

    curvature = second_difference(equations.left)
    by_curvature = mean(windows.reduced(curvature.square_())).mul_(_CURVATURE_NOISE)
    expected = torch.minimum(residual_variance * SLOPE_NOISE, by_curvature)
    energy = windows.reduced(equations.slope * equations.slope)
    mean_slope = mean(equations.mean_slope)
    texture = mean(energy).addcmul_(mean_slope, mean_slope, value=-1)
    chance = count.rsqrt_().mul_(confidence * _SPREAD**0.5 / block)
    proven = texture > chance.add_(1.0).mul_(expected)
    return TextureSupport(proven, _variance_aside(energy.mul_(windows.weight), expected, equations))


def _variance_aside(energy: Tensor, noise: Tensor, equations: LeftWindows) -> Tensor:
    """Variance of the centre's disparity, px², from the distance of the texture's centroid and the bare share around.

    A single pixel shows no slope at a crest of the texture, so that 3 x 3 pixels, or a block of 2 x 2, count as one.
    """
    windows, block = equations.windows, equations.block
    around, blocks = (window_sum(energy, 3), 9.0) if block == 1 else (energy, 1.0)
    bare = windows.mean(torch.le(around, noise * (_TEXTURED * blocks)).to(torch.float32))
    half = windows.size // 2
    whole = equations.texture.addcmul(equations.mean_slope, equations.mean_slope).sub_(noise)
    whole.mul_(windows.count).clamp_(min=1e-6)
    ones, ramp = np.ones(2 * half + 1), np.arange(-half, half + 1.0) * block
    across, down = (
        torch.from_numpy(cv2.sepFilter2D(energy.numpy(), -1, x, y, borderType=cv2.BORDER_CONSTANT))
        for x, y in ((ramp, ones), (ones, ramp))
    )
    distance = across.square_().addcmul_(down, down).div_(whole.square_()).clamp_(max=(half * block) ** 2)
    return distance.mul_(bare.square_()).mul_(_MISSED_SLOPE**2)
