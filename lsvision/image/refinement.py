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
    towards whole pixels; this does not. Where the window's texture is weaker than the noise, the disparity stays.

    Args:
        left, right: grey values of the pair.
        window: side of the square window, px, odd.
        noise: standard deviation of the grey values' noise, on their scale.
        largest_change_px: a larger total change is not believed and undone.

    Source: Lucas & Kanade 1981, in one dimension.
    """
    known = torch.isfinite(disparity)
    start = torch.where(known, disparity, 0.0)
    current = _filled_mean(start, known, window)
    left_detail = left - _mean(left, window)
    for _ in range(iterations):
        warped, slope = _warp_rows(right, current)
        residual = left_detail - (warped - _mean(warped, window))
        slope = slope - _mean(slope, window)
        energy = _mean(slope.square(), window)
        # The window's mean of noise times slope; the prior keeps untextured ground where matching put it.
        floor = 4.0 * noise**2 / window**2
        change = -_mean(slope * residual, window) / (energy + floor)
        current = current + change.clamp(-0.5, 0.5)
    believable = known & ((current - start).abs() <= largest_change_px)
    return torch.where(believable, current, disparity)


def _warp_rows(image: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes of an image at u - disparity along each line, by Catmull-Rom interpolation."""
    width = image.shape[1]
    position = (torch.arange(width, dtype=disparity.dtype) - disparity).clamp(1.0, width - 2.0)
    base = position.floor().clamp(max=width - 3)
    t = position - base
    index = base.long()
    a, b, c, d = (image.gather(1, index + shift) for shift in (-1, 0, 1, 2))
    linear, quadratic, cubic = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
    value = b + 0.5 * t * (linear + t * (quadratic + t * cubic))
    slope = 0.5 * (linear + t * (2 * quadratic + 3 * t * cubic))
    return value, slope


def _mean(values: Tensor, window: int) -> Tensor:
    """Mean over a square window, at the rim over the part of it within the image."""
    pad = window // 2
    across = F.avg_pool2d(values[None], (1, window), 1, (0, pad), count_include_pad=False)
    return F.avg_pool2d(across, (window, 1), 1, (pad, 0), count_include_pad=False)[0]


def _filled_mean(values: Tensor, known: Tensor, window: int) -> Tensor:
    """Mean over the known values of a window; the values themselves where the window holds none."""
    share = _mean(known.to(values.dtype), window)
    return torch.where(share > 0, _mean(values, window) / share.clamp(min=1e-6), values)
