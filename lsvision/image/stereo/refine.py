"""Sub-pixel disparity by local least squares on the warped pair, and how well it is known."""

import math
from dataclasses import dataclass

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.image.tiling import in_parallel

# Worked on at once: the dozen intermediate images of a tile then stay in the processor's cache.
_TILE_LINES, _TILE_COLUMNS = 256, 512
_SAME_SURFACE_PX = 0.5  # from a window's mean
_ROUNDING = 1.0 / 6.0  # variance of the difference of two whole grey values
# Variance of half the difference of two neighbours over that of the residual: half a pixel's noise, over one pixel's
# and that of another which interpolation has smoothed to 0.6 of it on average.
_SLOPE_NOISE = 0.5 / 1.6
_NOISE_RESIDUAL = 4.0  # times the noise's variance in one image; two have twice of it
_HOPELESS = 5.0  # times the largest deviation: from there on a disparity is a guess, however well it fits
_SMOOTH_PX = 4.0  # an interpolated value that differs by more from its block's own one mixes two surfaces


@dataclass(frozen=True)
class RefinedDisparity:
    """Disparity and its standard deviation, px; NaN where there is none."""

    disparity: Float[Tensor, "lines width"]
    sigma: Float[Tensor, "lines width"]


def refine_disparity(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines right_width"],
    disparity: Float[Tensor, "rows columns"],
    *,
    first_column: int = 0,
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

    A disparity for each 2 x 2 pixels, the last ones perhaps incomplete, is refined by all pixels of the images and
    interpolated at the end: neighbouring windows share most of their pixels and say little that is new.

    Args:
        left, right: grey values of the pair.
        disparity: px of the images, one value a pixel of the left one or a block of 2 x 2.
        first_column: of the right image is where the left one begins, which may be a part of it.
        window: side of the square window, px, odd; rounded up to an odd number of blocks.
        iterations: at least one.
        noise: standard deviation of the grey values' noise, on their scale.
        largest_change_px: a larger total change is not believed and undone.
        largest_sigma_px: a pixel known less well is dropped, unless its residual is no more than noise: ground without
            texture says little, but a wrong match says the wrong thing. Five times that is no measurement at all.

    Returns:
        Values for each pixel of the left image.

    Raises:
        ValueError: the disparity has neither one value a pixel nor one a block.

    Source: Lucas & Kanade 1981, in one dimension; Baker & Matthews 2004 for the slope of the image that is not warped.
    """
    block, (lines, width) = _block(left, disparity), left.shape
    window = 2 * (window // (2 * block)) + 1
    reach = 2 * iterations * (window // 2) + block - 1  # interpolation looks one block further
    refined, sigma = (disparity.new_empty(lines, width) for _ in range(2))
    scatter, largest = _scatter_gain(window, iterations), largest_sigma_px or math.inf

    def refine_rows(rows: tuple[int, int, int, int]) -> None:
        """Refine a row of tiles."""
        above, start, stop, below = rows
        left_rows, right_rows = (_whole_blocks(image, above, below, block) for image in (left, right))
        for before, first, last, after in _tiles(disparity.shape[1], _TILE_COLUMNS // block, reach):
            outer = disparity[above:below, before:after]
            pair = left_rows[:, block * before : block * after], right_rows
            column = first_column + block * before
            current, deviation, residual = _refine_tile(pair, outer, column, window, iterations, noise)
            current = outer + _small(current.sub_(outer), largest_change_px)
            deviation.mul_(scatter)
            wrong = (deviation > largest).logical_and_(residual > _NOISE_RESIDUAL * noise**2)
            current.masked_fill_(wrong.logical_or_(deviation > _HOPELESS * largest), torch.nan)
            tile = slice(block * start, block * stop), slice(block * first, block * last)
            _put_blocks((current, deviation), block, (start - above, first - before), (refined[tile], sigma[tile]))

    in_parallel(refine_rows, _tiles(disparity.shape[0], _TILE_LINES // block, reach))
    return RefinedDisparity(refined, sigma)


def _put_blocks(blocks: tuple[Tensor, Tensor], block: int, skip: tuple[int, int], out: tuple[Tensor, Tensor]) -> None:
    """Put disparity and deviation of blocks, but for the first rows and columns of them, into the pixels of a tile."""
    inner = tuple(slice(block * n, block * n + size) for n, size in zip(skip, out[0].shape, strict=True))
    out[0].copy_(enlarged(blocks[0], block)[inner])
    torch.add(out[0] - out[0], _repeated(blocks[1], block)[inner], out=out[1])  # NaN where the disparity is


def enlarged(disparity: Float[Tensor, "rows columns"], block: int) -> Float[Tensor, "lines width"]:
    """A value for each pixel of the blocks: interpolated on one surface, the block's own beside an edge or a gap."""
    if block == 1:
        return disparity
    own = _repeated(disparity, block)
    size = own.shape[1], own.shape[0]
    smooth = torch.from_numpy(cv2.resize(disparity.numpy(), size, interpolation=cv2.INTER_LINEAR))
    # A comparison with NaN is false.
    return torch.where((smooth - own).abs_() < _SMOOTH_PX, smooth, own)


def _block(image: Tensor, disparity: Tensor) -> int:
    """Pixels along the side of a disparity's block."""
    for block in (1, 2):
        if tuple(disparity.shape) == tuple(-(-size // block) for size in image.shape):
            return block
    raise ValueError(
        f"disparity must have a value for each pixel or each 2 x 2 pixels of images {tuple(image.shape)}, "
        f"got {tuple(disparity.shape)}"
    )


def _whole_blocks(image: Tensor, above: int, below: int, block: int) -> Tensor:
    """Grey values of some rows of blocks as float32, the edge repeated where the last blocks are incomplete."""
    values = image[block * above : block * below].to(torch.float32)
    bottom, right = block * (below - above) - values.shape[0], -values.shape[1] % block
    if bottom or right:
        values = torch.from_numpy(cv2.copyMakeBorder(values.numpy(), 0, bottom, 0, right, cv2.BORDER_REPLICATE))
    return values


def _repeated(values: Tensor, block: int) -> Tensor:
    """The value of its block for each pixel."""
    if block == 1:
        return values
    size = block * values.shape[1], block * values.shape[0]
    return torch.from_numpy(cv2.resize(values.numpy(), size, interpolation=cv2.INTER_NEAREST))


def _tiles(length: int, size: int, reach: int) -> list[tuple[int, int, int, int]]:
    """Tiles of a line of pixels: beginning with its margin, beginning, end, end with its margin."""
    starts = range(0, length, size)
    return [(max(s - reach, 0), s, min(s + size, length), min(s + size + reach, length)) for s in starts]


@dataclass(frozen=True)
class _Windows:
    """Square windows over the blocks of a tile that have a disparity."""

    known: Tensor  # 1 where there is one, 0 elsewhere
    count: Tensor  # of known blocks within the window
    size: int

    @classmethod
    def over(cls, known: Tensor, size: int) -> "_Windows":
        """Windows of ``size`` blocks a side."""
        return cls(known, _window_sum(known, size).clamp_(min=0.5), size)

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the known blocks of each window of a value for each block, or of one for each pixel."""
        size = self.known.shape[1], self.known.shape[0]
        if values.shape != self.known.shape:
            values = torch.from_numpy(cv2.resize(values.numpy(), size, interpolation=cv2.INTER_AREA))
        return _window_sum(values * self.known, self.size).div_(self.count)


def _refine_tile(
    pair: tuple[Tensor, Tensor], disparity: Tensor, column: int, window: int, iterations: int, noise: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Refined disparity, the standard deviation of one least-squares step, and the residual's variance, by block.

    The left image begins at ``column`` of the right one, which is whole: a partner may lie anywhere.
    """
    left, right = pair
    block = left.shape[0] // disparity.shape[0]
    windows = _Windows.over((disparity == disparity).to(left.dtype), window)  # unknown where it is NaN
    current = torch.nan_to_num(disparity)
    # The left image's slope: its noise is independent of the right one's, which interpolation smooths between pixels,
    # and a slope that shares that noise would pull disparities towards the middle between them.
    slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)).mul_(0.5)
    mean_slope = windows.mean(slope)
    texture = windows.mean(slope * slope).addcmul_(mean_slope, mean_slope, value=-1)
    # The window's mean of noise times slope; the prior keeps untextured ground where matching put it.
    prior = 4.0 * noise**2 / (block * window) ** 2
    energy = texture + prior
    for _ in range(iterations):
        current = _smoothed(current, windows)
        residual = _warp_rows(right, enlarged(current, block), column)
        torch.sub(left, residual, out=residual)
        mean_residual = windows.mean(residual)
        pull = windows.mean(slope * residual).addcmul_(mean_slope, mean_residual, value=-1)
        step = pull / energy
        current.sub_(step.clamp(-0.5, 0.5))
    spread = windows.mean(residual.square_()).addcmul_(mean_residual, mean_residual, value=-1)
    count = windows.count.mul_(block**2)
    freedom = (count - 2).clamp_(min=1)
    unexplained = spread.addcmul_(pull, step, value=-1).mul_(count).div_(freedom).clamp_(min=_ROUNDING)
    # The slope's own noise looks like texture but holds nothing.
    held = texture.sub_(unexplained, alpha=_SLOPE_NOISE).clamp_(min=0).add_(prior)
    sigma = energy.clamp_(min=0).mul_(unexplained).div_(count).sqrt_().div_(held)
    return current, sigma, unexplained


def _smoothed(current: Tensor, windows: _Windows) -> Tensor:
    """Disparity averaged over the window, but where that would mix two surfaces.

    The windows warp each pixel by its own disparity, which follows slanted ground; its noise would stay, however.
    """
    return _small(windows.mean(current).sub_(current), _SAME_SURFACE_PX).add_(current)


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
    position = torch.arange(column, stop, dtype=disparity.dtype).sub(disparity).clamp_(1.0, width - 2.0)
    base = position.floor().clamp_(max=width - 3)
    t = position.sub_(base)
    index = base.sub_(1.0).long()
    # One index into views that begin a pixel apart.
    a, b, c, d = (image[:, shift:].gather(1, index) for shift in range(4))
    linear, cubic = c - a, d.sub_(a).add_(b, alpha=3).sub_(c, alpha=3)
    quadratic = a.sub_(b).mul_(2).add_(linear).sub_(cubic)
    return b.addcmul_(t, linear.addcmul_(t, quadratic.addcmul_(t, cubic)), value=0.5)


def _window_sum(values: Tensor, window: int) -> Tensor:
    """Sum over a square window, at the rim over the part of it within the image."""
    size = window, window
    return torch.from_numpy(cv2.boxFilter(values.numpy(), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
