"""Sub-pixel disparity by local least squares on the warped pair, and how well it is known.

In the window around each block

1. the right image is warped by the current disparity (``warp_cubic``),
2. sums over the window (``Windows``) give the normal equation of the shift that fits it to the left image best,
3. the disparity takes this step, and after the last one
4. the variance of the residual and the texture give the step's sigma (``_fit_blocks``).

At the end implausible results are undone or dropped (``_accepted``) and blocks become pixels.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.image.stereo.blocks import block_side, enlarged, repeated, whole_blocks
from lsvision.image.stereo.warp import warp_cubic
from lsvision.image.stereo.windows import Windows
from lsvision.image.tiling import HaloRange, halo_ranges, in_parallel

# The dozen intermediate images of a tile of this size stay in the processor's cache.
_TILE_LINES, _TILE_COLUMNS = 256, 512
_SAME_SURFACE_PX = 0.5  # from the mean of a window
_LARGEST_STEP_PX = 0.5
_ROUNDING = 1.0 / 6.0  # variance of the difference of two whole grey values
# Variance of half the difference of two neighbours over that of the residual: half of a pixel's noise variance, over
# that of one pixel and of another which interpolation has smoothed to 0.6 of it on average.
_SLOPE_NOISE = 0.5 / 1.6
_NOISE_RESIDUAL = 4.0  # times the variance of the noise in one image; that of two images is twice as large
_HOPELESS = 5.0  # times the largest sigma: beyond it a disparity is a guess, however well it fits


@dataclass(frozen=True)
class RefineOptions:
    """How a disparity is refined.

    Args:
        window: side of the square window, px, odd; rounded up to an odd number of blocks.
        iterations: at least one.
        noise: sigma of the noise of grey values, on their scale.
        largest_change_px: a larger total change is implausible and is undone.
        largest_sigma_px: a pixel of larger sigma is dropped unless its residual is no more than noise: ground without
            texture gives little information, but a wrong match gives wrong information. A pixel of five times this
            sigma is always dropped.
    """

    window: int
    iterations: int
    noise: float
    largest_change_px: float = 1.0
    largest_sigma_px: float | None = None

    def window_blocks(self, block: int) -> int:
        """Side of the window in blocks of ``block`` pixels a side."""
        return 2 * (self.window // (2 * block)) + 1


@dataclass(frozen=True)
class RefinedDisparity:
    """Disparity and its sigma, px; NaN where there is none."""

    disparity: Float[Tensor, "lines width"]
    sigma: Float[Tensor, "lines width"]


def refine_disparity(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines right_width"],
    disparity: Float[Tensor, "rows columns"],
    options: RefineOptions,
    *,
    first_column: int = 0,
) -> RefinedDisparity:
    """Improve a disparity map that is good to about a pixel; NaN stays NaN.

    In a window around each pixel the right image, warped by the current disparity, is shifted so that it fits the left
    one best; brightness may differ by an offset. Semi-global matching interpolates its costs, which pulls disparities
    towards whole pixels; least squares on grey values do not. Where a window has no texture, the disparity stays.

    Sigma follows from the residuals in the window after the last step and from the texture.

    A disparity for each 2 x 2 pixels, the last ones perhaps incomplete, is refined by all pixels of the images and
    interpolated at the end: neighbouring windows share most of their pixels and add little information.

    Args:
        left, right: grey values of the pair; the left image may be a part of the right one's width.
        disparity: px of the images, one value for each pixel of the left one or for each block of 2 x 2.
        first_column: column of the right image at which the left one begins.

    Returns:
        Values for each pixel of the left image.

    Raises:
        ValueError: the disparity has neither one value for each pixel nor one for each block.

    Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped.
    """
    block, (lines, width) = block_side(left, disparity), left.shape
    window = options.window_blocks(block)
    halo = 2 * options.iterations * (window // 2) + block - 1  # interpolation reads one block further
    gain = _sigma_gain(window, options.iterations)
    result = RefinedDisparity(disparity.new_empty(lines, width), disparity.new_empty(lines, width))

    def refine_rows(rows: HaloRange) -> None:
        """Refine a row of tiles."""
        left_rows, right_rows = (whole_blocks(image, rows.outer, block) for image in (left, right))
        for columns in halo_ranges(disparity.shape[1], _TILE_COLUMNS // block, halo):
            start = disparity[rows.outer, columns.outer]
            pixels = slice(block * columns.outer_start, block * columns.outer_stop)
            fit = _fit_blocks(left_rows[:, pixels], right_rows, start, first_column + pixels.start, options)
            _write_pixels(_accepted(fit, start, gain, options), block, (rows, columns), result)

    in_parallel(refine_rows, halo_ranges(disparity.shape[0], _TILE_LINES // block, halo))
    return result


@dataclass(frozen=True)
class _Fit:
    """Disparity of the blocks of a tile, sigma of one least-squares step, and variance of the residual grey values."""

    disparity: Tensor
    sigma: Tensor
    residual_variance: Tensor


def _fit_blocks(left: Tensor, right: Tensor, start: Tensor, first_column: int, options: RefineOptions) -> _Fit:
    """Least squares in the windows of a tile, from the disparities ``start`` of its blocks on.

    With s the slope of the left image, e = left - warped right and cov over a window, a change by -q fits best where
    ``(cov(s, s) + prior) q = cov(s, e)``; an offset of brightness drops out of the covariances.

    Args:
        left: grey values of the tile, float32, which begin at ``first_column`` of the right image.
        right: whole lines, since a partner may lie anywhere.
    """
    block = left.shape[0] // start.shape[0]
    windows = Windows.over(start == start, options.window_blocks(block))  # invalid where it is NaN
    # The slope of the left image has noise independent of the right one. Interpolation smooths the right image between
    # its pixels: a slope that shared its noise would pull disparities towards the middle between them.
    slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)).mul_(0.5)
    mean_slope = windows.mean(slope)
    texture = windows.covariance(slope, slope, mean_slope, mean_slope)
    # The variance of the window's mean of noise times slope; it keeps untextured ground where matching put it.
    prior = 4.0 * options.noise**2 / (block * windows.size) ** 2
    normal = texture + prior
    disparity = torch.nan_to_num(start)
    for _ in range(options.iterations):
        disparity = _smoothed(disparity, windows)
        residual = left - warp_cubic(right, enlarged(disparity, block), first_column)
        mean_residual = windows.mean(residual)
        pull = windows.covariance(slope, residual, mean_slope, mean_residual)
        step = pull / normal
        disparity.sub_(step.clamp(-_LARGEST_STEP_PX, _LARGEST_STEP_PX))
    variance = windows.covariance(residual, residual, mean_residual, mean_residual)
    pixels = windows.count * block**2
    freedom = (pixels - 2).clamp_(min=1)
    residual_variance = torch.addcmul(variance, pull, step, value=-1).mul_(pixels).div_(freedom).clamp_(min=_ROUNDING)
    # The noise of the slope looks like texture but carries no information.
    normal_without_noise = texture.sub(residual_variance, alpha=_SLOPE_NOISE).clamp_(min=0).add_(prior)
    sigma = normal.clamp(min=0).mul_(residual_variance).div_(pixels).sqrt_().div_(normal_without_noise)
    return _Fit(disparity, sigma, residual_variance)


def _smoothed(disparity: Tensor, windows: Windows) -> Tensor:
    """Disparity averaged over the window, except where this would mix two surfaces.

    Each pixel is warped by its own disparity, which follows slanted ground; without averaging its noise would remain.
    """
    return _zero_beyond(windows.mean(disparity).sub_(disparity), _SAME_SURFACE_PX).add_(disparity)


def _zero_beyond(change: Tensor, limit: float) -> Tensor:
    """Changes up to a limit; zero instead of larger ones."""
    return change - F.hardshrink(change, limit)


def _sigma_gain(window: int, iterations: int) -> float:
    """Sigma after some iterations over that of a single one.

    With B the mean over a window, a step from disparities in error by e leaves ``(1 - B) B e`` of it and adds the
    error of the step.
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


def _accepted(fit: _Fit, start: Tensor, gain: float, options: RefineOptions) -> _Fit:
    """A fit whose too large changes are undone and whose too uncertain disparities are NaN."""
    largest = options.largest_sigma_px or math.inf
    sigma = fit.sigma * gain
    mismatched = (sigma > largest).logical_and_(fit.residual_variance > _NOISE_RESIDUAL * options.noise**2)
    dropped = mismatched.logical_or_(sigma > _HOPELESS * largest)
    disparity = start + _zero_beyond(fit.disparity - start, options.largest_change_px)
    return _Fit(disparity.masked_fill_(dropped, torch.nan), sigma, fit.residual_variance)


def _write_pixels(fit: _Fit, block: int, ranges: tuple[HaloRange, HaloRange], result: RefinedDisparity) -> None:
    """Write what blocks give for each of their pixels, without the halo, into the maps of the image."""
    tile = tuple(slice(block * part.start, block * part.stop) for part in ranges)
    disparity, sigma = result.disparity[tile], result.sigma[tile]
    inner = tuple(
        slice(block * part.inner.start, block * part.inner.start + size)  # the last blocks may be incomplete
        for part, size in zip(ranges, disparity.shape, strict=True)
    )
    disparity.copy_(enlarged(fit.disparity, block)[inner])
    torch.add(disparity - disparity, repeated(fit.sigma, block)[inner], out=sigma)  # NaN where the disparity is
