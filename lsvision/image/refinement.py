"""Sub-pixel disparity by local least squares on the warped pair, and how well it is known."""

import math
from dataclasses import dataclass

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Shaped
from torch import Tensor

# Worked on at once: the two dozen intermediate images then stay in the processor's cache.
_TILE_LINES, _TILE_COLUMNS = 96, 1024
_SAME_SURFACE_PX = 0.5  # from a window's mean
_ROUNDING = 1.0 / 6.0  # variance of the difference of two whole grey values
# Variance of half the difference of two neighbours over that of the residual: half a pixel's noise, over one pixel's
# and that of another which interpolation has smoothed to 0.6 of it on average.
_SLOPE_NOISE = 0.5 / 1.6
_NOISE_RESIDUAL = 4.0  # times the noise's variance in one image; two have twice of it


@dataclass(frozen=True)
class RefinedDisparity:
    """Disparity and its standard deviation, px; NaN where there is none."""

    disparity: Float[Tensor, "lines width"]
    sigma: Float[Tensor, "lines width"]


def refine_disparity(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines width"],
    disparity: Float[Tensor, "lines width"],
    *,
    window: int,
    iterations: int,
    noise: float,
    largest_change_px: float = 1.0,
    largest_sigma_px: float | None = None,
) -> RefinedDisparity:
    """Improve a disparity map good to about a pixel; NaN stays NaN.

    In a window around each pixel the right image, warped by the current disparity, is shifted so that it fits the left
    one best; brightness may differ by an offset. Semi-global matching interpolates its costs, which pulls disparities
    towards whole pixels; this does not. Where a window has no texture, the disparity stays.

    The standard deviation follows from the residuals left in the window and the texture that holds the disparity.

    Args:
        left, right: grey values of the pair.
        window: side of the square window, px, odd.
        iterations: at least one.
        noise: standard deviation of the grey values' noise, on their scale.
        largest_change_px: a larger total change is not believed and undone.
        largest_sigma_px: a pixel known less well is dropped, unless its residual is no more than noise: ground without
            texture says little, but a wrong match says the wrong thing.

    Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped.
    """
    (lines, width), reach = disparity.shape, 2 * iterations * (window // 2)
    refined, sigma = torch.empty_like(disparity), torch.empty_like(disparity)
    scatter, largest = _scatter_gain(window, iterations), largest_sigma_px or math.inf
    for above, start, stop, below in _tiles(lines, _TILE_LINES, reach):
        pair = left[above:below].to(disparity.dtype), right[above:below].to(disparity.dtype)
        for before, first, last, after in _tiles(width, _TILE_COLUMNS, reach):
            tile = slice(start, stop), slice(first, last)
            inner = slice(start - above, stop - above), slice(first - before, last - before)
            outer = disparity[above:below, before:after]
            current, deviation, residual = (
                values[inner] for values in _refine_tile(pair, outer, before, window, iterations, noise)
            )
            torch.mul(deviation, scatter, out=sigma[tile])
            torch.add(disparity[tile], _small(current - disparity[tile], largest_change_px), out=refined[tile])
            dropped = (sigma[tile] > largest) & (residual > _NOISE_RESIDUAL * noise**2)
            for values in (refined, sigma):
                values[tile].masked_fill_(dropped, torch.nan)
    return RefinedDisparity(refined, sigma)


def _tiles(length: int, size: int, reach: int) -> list[tuple[int, int, int, int]]:
    """Tiles of a line of pixels: beginning with its margin, beginning, end, end with its margin."""
    starts = range(0, length, size)
    return [(max(s - reach, 0), s, min(s + size, length), min(s + size + reach, length)) for s in starts]


def _refine_tile(
    pair: tuple[Tensor, Tensor], disparity: Tensor, column: int, window: int, iterations: int, noise: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Refined disparity, the standard deviation of one least-squares step, and the residual's variance.

    The disparity begins at ``column`` of the images, which are whole: a partner may lie anywhere.
    """
    left, right = pair[0][:, column : column + disparity.shape[1]], pair[1]
    missing = disparity - disparity  # NaN where there is none
    known = (missing == 0).to(left.dtype)
    current = torch.nan_to_num(disparity)
    count = _window_sum(known, window).clamp_(min=0.5)
    # The left image's slope: its noise is independent of the right one's, which interpolation smooths between pixels,
    # and a slope that shares that noise would pull disparities towards the middle between them.
    slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)).mul_(0.5).mul_(known)
    mean_slope = _window_sum(slope, window).div_(count)
    texture = _window_sum(slope * slope, window).div_(count).addcmul_(mean_slope, mean_slope, value=-1)
    # The window's mean of noise times slope; the prior keeps untextured ground where matching put it.
    prior = 4.0 * noise**2 / window**2
    energy = texture + prior
    for _ in range(iterations):
        current = _smoothed(current, known, count, window)
        residual = (left - _warp_rows(right, current, column)).mul_(known)
        mean_residual = _window_sum(residual, window).div_(count)
        pull = _window_sum(slope * residual, window).div_(count).addcmul_(mean_slope, mean_residual, value=-1)
        step = pull / energy
        current = current - step.clamp(-0.5, 0.5)
    spread = _window_sum(residual * residual, window).div_(count).addcmul_(mean_residual, mean_residual, value=-1)
    unexplained = spread.addcmul_(pull, step, value=-1).mul_(count / (count - 2).clamp_(min=1)).clamp_(min=_ROUNDING)
    # The slope's own noise looks like texture but holds nothing.
    held = texture.sub_(unexplained, alpha=_SLOPE_NOISE).clamp_(min=0).add_(prior)
    sigma = (unexplained * energy.clamp_(min=0)).div_(count).sqrt_().div_(held)
    return current.add_(missing), sigma.add_(missing), unexplained


def _smoothed(current: Tensor, known: Tensor, count: Tensor, window: int) -> Tensor:
    """Disparity averaged over the window, but where that would mix two surfaces.

    The windows warp each pixel by its own disparity, which follows slanted ground; its noise would stay, however.
    """
    change = _window_sum(current * known, window) / count - current
    return current + _small(change, _SAME_SURFACE_PX)


def _small(change: Tensor, limit: float) -> Tensor:
    """Changes up to a limit; zero for larger ones."""
    return change - F.hardshrink(change, limit)


def _scatter_gain(window: int, iterations: int) -> float:
    """Standard deviation after some iterations over that of a single one.

    With B the mean over a window, a step from disparities in error by e leaves ``(1 - B) B e`` of it and adds the
    step's own noise.
    """
    size = 8 * window * iterations
    box = torch.zeros(size, dtype=torch.float64)
    box[: window // 2 + 1] = box[size - window // 2 :] = 1.0 / window
    smoothing = torch.fft.fft(box).real
    smoothing = smoothing[:, None] * smoothing
    result = smoothing
    for _ in range(iterations - 1):
        result = smoothing + (1 - smoothing) * smoothing * result
    return float((result.square().mean() / smoothing.square().mean()).sqrt())


def _warp_rows(image: Tensor, disparity: Tensor, column: int = 0) -> Tensor:
    """Values of an image at u - disparity along each line, u from ``column`` on, by Catmull-Rom interpolation."""
    width, stop = image.shape[1], column + disparity.shape[1]
    position = (torch.arange(column, stop, dtype=disparity.dtype) - disparity).clamp_(1.0, width - 2.0)
    base = position.floor().clamp_(max=width - 3)
    t = position - base
    index = base.long()
    a, b, c, d = (image.gather(1, index + shift) for shift in (-1, 0, 1, 2))
    linear, quadratic, cubic = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
    return b + 0.5 * t * (linear + t * (quadratic + t * cubic))


def _window_sum(values: Tensor, window: int) -> Tensor:
    """Sum over a square window, at the rim over the part of it within the image."""
    size = window, window
    return torch.from_numpy(cv2.boxFilter(values.numpy(), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
