"""Sub-pixel disparity by local least squares on the warped pair, and how well it is known.

In the window around each block

1. the right image is warped by the current disparity (``CubicLines``),
2. least squares give the shift that fits it to the left image best (``LeftWindows.fit``),
3. the disparity takes this step, and after the last one
4. the variance of the residual and the texture give the step's sigma (``LeftWindows.certainty``).

At the end implausible results are undone or dropped (``_accepted``), the scatter of the disparities joins the sigma
(``with_scatter``).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.image.stereo.blocks import block_side, enlarged, whole_blocks
from lsvision.image.stereo.scatter import SigmaGains, with_scatter
from lsvision.image.stereo.shift import Certainty, LeftWindows, explained_share
from lsvision.image.stereo.texture import TextureSupport, texture_support
from lsvision.image.stereo.warp import CubicLines
from lsvision.image.stereo.windows import Windows
from lsvision.image.tiling import HaloRange, halo_ranges, in_parallel

# The dozen intermediate images of a tile of this size stay in the processor's cache.
_TILE_LINES, _TILE_COLUMNS = 256, 1024
_SAME_SURFACE_PX = 0.5  # from the mean of a window
_LARGEST_STEP_PX = 0.5
_NOISE_RESIDUAL = 4.0  # times the variance of the noise in one image; that of two images is twice as large
_EXPLAINED = 6.0  # the largest sigma grows by so many times with the share of the grey values that the match explains


@dataclass(frozen=True)
class RefineOptions:
    """How a disparity is refined.

    Args:
        window: side of the square window, px, odd; rounded up to an odd number of blocks.
        iterations: at least one.
        noise: sigma of the noise of grey values, on their scale.
        largest_change_px: a larger total change is implausible and is undone.
        largest_sigma_px: a pixel of larger sigma is dropped where the match explains nothing of the grey values around
            it; where it explains all, noise aside, 7 times as much is allowed. Infinity keeps all.
        largest_misfit_px: a pixel whose residual is above noise, and would explain a shift by more than this, is
            dropped: ground without texture gives little information, but a wrong match gives wrong information.
        with_gain: brightness may differ by a factor, too, not by an offset only.
        with_sigma: False leaves sigma unknown, which saves time, and ``largest_sigma_px`` without effect.
        texture_confidence: a pixel is dropped unless the texture around it exceeds noise by as many standard
            deviations, and its sigma covers what texture aside of it leaves open; None does neither.
    """

    window: int
    iterations: int
    noise: float
    largest_change_px: float = 1.0
    largest_sigma_px: float = math.inf
    largest_misfit_px: float = math.inf
    with_gain: bool = False
    with_sigma: bool = True
    texture_confidence: float | None = None

    @property
    def judges(self) -> bool:
        """Whether anything depends on how certain a disparity is."""
        return self.with_sigma or self.largest_misfit_px < math.inf

    def window_blocks(self, block: int) -> int:
        """Side of the window in blocks of ``block`` pixels a side."""
        return 2 * (self.window // (2 * block)) + 1


@dataclass(frozen=True)
class RefinedDisparity:
    """Of each block: disparity and its sigma, px, and the variance of the grey values that it leaves around the block.

    NaN where there is none.
    """

    disparity: Float[Tensor, "rows columns"]
    sigma: Float[Tensor, "rows columns"]
    residual_variance: Float[Tensor, "rows columns"]


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
    one best; brightness may differ by an offset and, ``with_gain``, by a factor. Semi-global matching interpolates its
    costs, which pulls disparities towards whole pixels; least squares on grey values do not. Where a window has no
    texture, the disparity stays.

    Sigma follows from the residuals and the texture in the window, as in any least squares, and from the scatter of
    the disparities around their mean over a window. Least squares alone count every residual as noise of its own: on
    photographs, whose residuals are mostly other light, other blur and surfaces that are no plane, it claims 2.6 times
    too little. The scatter is an error that has been seen.

    A disparity for each 2 x 2 pixels, the last ones perhaps incomplete, is refined by all pixels of the images;
    ``enlarged`` gives that of each pixel: neighbouring windows share most of their pixels and add little information.

    Args:
        left, right: grey values of the pair; the left image may be a part of the right one's width.
        disparity: px of the images, one value for each pixel of the left one or for each block of 2 x 2.
        first_column: column of the right image at which the left one begins.

    Raises:
        ValueError: the disparity has neither one value for each pixel nor one for each block.
    """
    block = block_side(left, disparity)
    window = options.window_blocks(block)
    reach = options.iterations + (1 if options.with_sigma else 0)
    halo = 2 * reach * (window // 2)
    gains = SigmaGains.of(window, options.iterations)
    result = RefinedDisparity(*(torch.empty_like(disparity) for _ in range(3)))

    def refine_rows(rows: HaloRange) -> None:
        """Refine a row of tiles."""
        left_rows = whole_blocks(left, rows.outer, block)
        right_rows = CubicLines.of(whole_blocks(right, rows.outer, block))
        for columns in halo_ranges(disparity.shape[1], _TILE_COLUMNS // block, halo):
            start = disparity[rows.outer, columns.outer]
            pixels = slice(block * columns.outer_start, block * columns.outer_stop)
            refined = _refine_blocks(left_rows[:, pixels], right_rows, start, first_column + pixels.start, options)
            _write(_accepted(refined, start, gains, options), (rows, columns), result)

    in_parallel(refine_rows, halo_ranges(disparity.shape[0], _TILE_LINES // block, halo))
    return result


@dataclass(frozen=True)
class _Refined:
    """Disparity of the blocks of a tile, how certain the last step was, and the windows that it used.

    ``explained`` is the share of the left image's variance that the match explains, ``support`` what texture proves.
    None is what nobody asks for.
    """

    disparity: Tensor
    certainty: Certainty | None
    windows: Windows
    explained: Tensor | None
    support: TextureSupport | None


def _refine_blocks(
    left: Tensor, right: CubicLines, start: Tensor, first_column: int, options: RefineOptions
) -> _Refined:
    """Least squares in the windows of a tile, from the disparities ``start`` of its blocks on.

    Args:
        left: grey values of the tile, float32, which begin at ``first_column`` of the right image.
        right: whole lines, since a partner may lie anywhere.
    """
    block = left.shape[0] // start.shape[0]
    windows = Windows.over(start == start, options.window_blocks(block))  # invalid where it is NaN
    equations = LeftWindows.of(left, windows, options.noise, with_gain=options.with_gain)
    disparity = torch.nan_to_num(start)
    for _ in range(options.iterations):
        disparity = _smoothed(disparity, windows)
        residual = left - right.at(enlarged(disparity, block), first_column)
        fit = equations.fit(residual)
        disparity.sub_(fit.step.clamp(-_LARGEST_STEP_PX, _LARGEST_STEP_PX))
    certainty = equations.certainty(residual, fit) if options.judges else None
    explained = None
    if certainty is not None and options.with_sigma and options.largest_sigma_px < math.inf:
        explained = explained_share(left, windows, certainty.residual_variance, options.noise)
    support = None
    if certainty is not None and options.texture_confidence is not None:
        support = texture_support(equations, certainty.residual_variance, options.texture_confidence)
    return _Refined(disparity, certainty, windows, explained, support)


def _smoothed(disparity: Tensor, windows: Windows) -> Tensor:
    """Disparity averaged over the window, except where this would mix two surfaces.

    Each pixel is warped by its own disparity, which follows slanted ground; without averaging its noise would remain.
    """
    return _zero_beyond(windows.mean(disparity).sub_(disparity), _SAME_SURFACE_PX).add_(disparity)


def _zero_beyond(change: Tensor, limit: float) -> Tensor:
    """Changes up to a limit; zero instead of larger ones."""
    return change - F.hardshrink(change, limit)


def _accepted(refined: _Refined, start: Tensor, gains: SigmaGains, options: RefineOptions) -> RefinedDisparity:
    """Disparity of blocks whose too large changes are undone, NaN where it is too uncertain, and its sigma."""
    disparity = start + _zero_beyond(refined.disparity - start, options.largest_change_px)
    if refined.certainty is None:
        unknown = torch.full_like(disparity, torch.nan)
        return RefinedDisparity(disparity, unknown, unknown)
    sigma = refined.certainty.sigma * gains.iterations
    noisy = refined.certainty.residual_variance > _NOISE_RESIDUAL * options.noise**2
    dropped = (sigma > options.largest_misfit_px).logical_and_(noisy)
    if options.with_sigma:
        sigma = with_scatter(sigma, disparity, refined.windows, gains)
    if refined.explained is not None:
        dropped.logical_or_(sigma > (_EXPLAINED * refined.explained).add_(1.0).mul_(options.largest_sigma_px))
    if refined.support is not None:
        dropped.logical_or_(~refined.support.proven)
        sigma = sigma.square_().add_(refined.support.variance).sqrt_()
    disparity.masked_fill_(dropped, torch.nan)
    missing = disparity - disparity  # NaN where there is none, else zero
    return RefinedDisparity(disparity, sigma.add_(missing), refined.certainty.residual_variance + missing)


def _write(tile: RefinedDisparity, ranges: tuple[HaloRange, HaloRange], result: RefinedDisparity) -> None:
    """Write the values of a tile, without its halo, into the maps."""
    own = tuple(slice(part.start, part.stop) for part in ranges)
    inner = tuple(part.inner for part in ranges)
    for target, values in (
        (result.disparity, tile.disparity),
        (result.sigma, tile.sigma),
        (result.residual_variance, tile.residual_variance),
    ):
        target[own] = values[inner]
