"""Sub-pixel disparity by local least squares on the warped pair, and how well it is known."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

# Lines worked on at once: the two dozen intermediate images then stay in the processor's cache.
_BAND = 64
_SAME_SURFACE_PX = 0.5  # from a window's mean
_ROUNDING = 1.0 / 6.0  # variance of the difference of two whole grey values
# Variance of half the difference of two neighbours over that of the residual: half a pixel's noise, over one pixel's
# and that of another which interpolation has smoothed to 0.6 of it on average.
_SLOPE_NOISE = 0.5 / 1.6


@dataclass(frozen=True)
class RefinedDisparity:
    """Disparity and its standard deviation, px, and the rms grey value that no shift explains; NaN as the start."""

    disparity: Float[Tensor, "lines width"]
    sigma: Float[Tensor, "lines width"]
    residual: Float[Tensor, "lines width"]


def refine_disparity(
    left: Float[Tensor, "lines width"],
    right: Float[Tensor, "lines width"],
    disparity: Float[Tensor, "lines width"],
    *,
    window: int,
    iterations: int,
    noise: float,
    largest_change_px: float = 1.0,
) -> RefinedDisparity:
    """Improve a disparity map good to about a pixel; NaN stays NaN.

    In a window around each pixel the right image, warped by the current disparity, is shifted so that it fits the left
    one best; brightness may differ by an offset. Semi-global matching interpolates its costs, which pulls disparities
    towards whole pixels; this does not. Where a window has no texture, the disparity stays.

    The standard deviation follows from the residuals left in the window and the texture that holds the disparity, and
    is never below that of the given noise alone.

    Args:
        left, right: grey values of the pair.
        window: side of the square window, px, odd.
        iterations: at least one.
        noise: standard deviation of the grey values' noise, on their scale.
        largest_change_px: a larger total change is not believed and undone.

    Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped.
    """
    lines, reach = left.shape[0], 2 * iterations * (window // 2)
    refined, sigma, residual = (torch.empty_like(disparity) for _ in range(3))
    scatter = _scatter_gain(window, iterations)
    for start in range(0, lines, _BAND):
        stop = min(start + _BAND, lines)
        above, below = max(start - reach, 0), min(stop + reach, lines)
        pair, first = (left[above:below], right[above:below]), disparity[above:below]
        current, deviation, unexplained = _refine_band(pair, first, window, iterations, noise, largest_change_px)
        inner = slice(start - above, stop - above)
        refined[start:stop], sigma[start:stop] = current[inner], scatter * deviation[inner]
        residual[start:stop] = unexplained[inner]
    return RefinedDisparity(refined, sigma, residual)


def _refine_band(
    pair: tuple[Tensor, Tensor],
    disparity: Tensor,
    window: int,
    iterations: int,
    noise: float,
    largest_change_px: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Refined disparity, the standard deviation of one least-squares step, and the rms residual."""
    left, right = pair
    start = torch.nan_to_num(disparity)
    known = torch.isfinite(disparity).to(left.dtype)
    count = _window_sum(known, window).clamp_(min=0.5)
    # The left image's slope: its noise is independent of the right one's, which interpolation smooths between pixels,
    # and a slope that shares that noise would pull disparities towards the middle between them.
    slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)) / 2 * known
    mean_slope = _window_sum(slope, window) / count
    texture = _window_sum(slope * slope, window) / count - mean_slope * mean_slope
    # The window's mean of noise times slope; the prior keeps untextured ground where matching put it.
    prior = 4.0 * noise**2 / window**2
    energy = texture + prior
    current = start
    for _ in range(iterations):
        current = _smoothed(current, known, count, window)
        residual = (left - _warp_rows(right, current)) * known
        mean_residual = _window_sum(residual, window) / count
        pull = _window_sum(slope * residual, window) / count - mean_slope * mean_residual
        step = pull / energy
        current = current - step.clamp(-0.5, 0.5)
    spread = _window_sum(residual * residual, window) / count - mean_residual * mean_residual
    unexplained = ((spread - pull * step) * count / (count - 2).clamp(min=1)).clamp(min=_ROUNDING)
    # The slope's own noise looks like texture but holds nothing.
    held = (texture - _SLOPE_NOISE * unexplained).clamp(min=0) + prior
    sigma = (unexplained * energy.clamp(min=0) / count).sqrt() / held
    changed = ((current - start).abs() > largest_change_px).to(left.dtype)
    missing = disparity - disparity  # NaN where there was none
    return current + changed * (start - current) + missing, sigma + missing, unexplained.sqrt() + missing


def _smoothed(current: Tensor, known: Tensor, count: Tensor, window: int) -> Tensor:
    """Disparity averaged over the window, but where that would mix two surfaces.

    The windows warp each pixel by its own disparity, which follows slanted ground; its noise would stay, however.
    """
    change = _window_sum(current * known, window) / count - current
    return current + change * (change.abs() < _SAME_SURFACE_PX)


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


def _warp_rows(image: Tensor, disparity: Tensor) -> Tensor:
    """Values of an image at u - disparity along each line, by Catmull-Rom interpolation."""
    width = image.shape[1]
    position = (torch.arange(width, dtype=disparity.dtype) - disparity).clamp_(1.0, width - 2.0)
    base = position.floor().clamp_(max=width - 3)
    t = position - base
    index = base.long()
    a, b, c, d = (image.gather(1, index + shift) for shift in (-1, 0, 1, 2))
    linear, quadratic, cubic = c - a, 2 * a - 5 * b + 4 * c - d, 3 * (b - c) + d - a
    return b + 0.5 * t * (linear + t * (quadratic + t * cubic))


def _window_sum(values: Tensor, window: int) -> Tensor:
    """Sum over a square window, at the rim over the part of it within the image."""
    pad = window // 2
    return _run_sum(_run_sum(F.pad(values, (pad, pad, pad, pad)), window, 1), window, 0)


def _run_sum(values: Tensor, length: int, dim: int) -> Tensor:
    """Sums over runs of ``length``, by doubling: a few additions instead of one for each of the run."""
    kept = values.shape[dim] - length + 1
    total, done, power, run = None, 0, 1, values
    while True:
        if length & power:
            part = run.narrow(dim, done, kept)
            total, done = part if total is None else total + part, done + power
        if done == length:
            return total  # type: ignore[return-value]
        run = run.narrow(dim, 0, run.shape[dim] - power) + run.narrow(dim, power, run.shape[dim] - power)
        power *= 2
