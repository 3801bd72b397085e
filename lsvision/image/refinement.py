"""Sub-pixel disparity by local least squares on the warped pair."""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor


def refine_disparity(
    left: Float[Tensor, "lines width"],
    right: Float[Tensor, "lines width"],
    disparity: Float[Tensor, "lines width"],
    *,
    window: int,
    iterations: int,
    noise: float,
    largest_change_px: float = 1.0,
) -> Float[Tensor, "lines width"]:
    """Improve a disparity map good to about a pixel; NaN stays NaN.

    In a window around each pixel the right image, warped by the current disparity, is shifted so that it fits the left
    one best; brightness may differ by an offset. Semi-global matching interpolates its costs, which pulls disparities
    towards whole pixels; this does not. Where a window has no texture, the disparity stays.

    Args:
        left, right: grey values of the pair.
        window: side of the square window, px, odd.
        noise: standard deviation of the grey values' noise, on their scale.
        largest_change_px: a larger total change is not believed and undone.

    Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped.
    """
    known = torch.isfinite(disparity)
    start = torch.where(known, disparity, 0.0)
    weight = known.to(left.dtype)
    share = _mean(weight, window).clamp(min=0.5 / window**2)

    def mean(values: Tensor) -> Tensor:
        """Mean over the pixels of a window whose disparity is known."""
        return _mean(weight * values, window) / share

    current = mean(start)
    left_detail = left - mean(left)
    # The left image's slope: its noise is independent of the right one's, which interpolation smooths between pixels,
    # and a slope that shares that noise would pull disparities towards the middle between them.
    slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)) / 2
    slope = slope - mean(slope)
    # The window's mean of noise times slope; the prior keeps untextured ground where matching put it.
    energy = mean(slope.square()) + 4.0 * noise**2 / window**2
    for _ in range(iterations):
        warped = _warp_rows(right, current)
        residual = left_detail - (warped - mean(warped))
        current = current - (mean(slope * residual) / energy).clamp(-0.5, 0.5)
    believable = known & ((current - start).abs() <= largest_change_px)
    return torch.where(believable, current, disparity)


def _warp_rows(image: Tensor, disparity: Tensor) -> Tensor:
    """Values of an image at u - disparity along each line, by Catmull-Rom interpolation."""
    width = image.shape[1]
    position = (torch.arange(width, dtype=disparity.dtype) - disparity).clamp(1.0, width - 2.0)
    base = position.floor().clamp(max=width - 3)
    t = position - base
    index = base.long()
    a, b, c, d = (image.gather(1, index + shift) for shift in (-1, 0, 1, 2))
    linear, quadratic, cubic = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
    return b + 0.5 * t * (linear + t * (quadratic + t * cubic))


def _mean(values: Tensor, window: int) -> Tensor:
    """Mean over a square window, at the rim over the part of it within the image."""
    pad = window // 2
    across = F.avg_pool2d(values[None], (1, window), 1, (0, pad), count_include_pad=False)
    return F.avg_pool2d(across, (window, 1), 1, (pad, 0), count_include_pad=False)[0]
