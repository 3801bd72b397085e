"""Resampling of images at given positions, by ``grid_sample`` or by OpenCV."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from lsvision.image.smoothing import smoothed, smoothing_radius
from lsvision.image.tiling import PIXEL_PARTS

Interpolation = Literal["bilinear", "bicubic"]
Resampler = Literal["grid_sample", "opencv"]

# Rows and columns to sample at once. Skewed by 3°, the image under a tile of grid_sample's stays in the processor's
# cache; OpenCV divides its work itself.
SAMPLED_TILES: dict[Resampler, tuple[int, int]] = {"grid_sample": (128, 480), "opencv": (512, 480)}

_LARGEST_WINDOW = 8192
_LARGEST_REMAPPED = 32766  # up to which OpenCV counts pixels
_REACH = 2  # pixels beside a position that an interpolation reads
_OUTSIDE = -16.0  # a position outside of any window, where samples are 0
_CV2_MODES = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}


@dataclass(frozen=True)
class Sampling:
    """How images are sampled.

    Args:
        coarser: distance of neighbouring samples in lines and in columns, px; where it exceeds 1, the images are
            smoothed first, so that no detail finer than the samples turns into a false pattern.
    """

    interpolation: Interpolation
    resampler: Resampler = "grid_sample"
    coarser: tuple[float, float] = (1.0, 1.0)


def sample_image(
    image: Tensor,
    column: Float[Tensor, "rows columns"],
    line: Float[Tensor, "rows columns"],
    sampling: Sampling,
    *,
    first_line: int = 0,
    out: Tensor | None = None,
) -> Tensor:
    """Sample one image ``(lines, width, channels)``; see ``sample_images``."""
    outs = None if out is None else (out,)
    return sample_images((image,), column, line, sampling, first_line=first_line, out=outs)[0]


def sample_images(
    images: Sequence[Tensor],
    column: Float[Tensor, "rows columns"],
    line: Float[Tensor, "rows columns"],
    sampling: Sampling,
    *,
    first_line: int = 0,
    out: Sequence[Tensor] | None = None,
) -> Sequence[Tensor]:
    """Sample images ``(lines, width, channels)`` of one size at positions in px, all of them in one call.

    Positions are rounded to 1/2048 px: cut from a larger image, at any place, an image gives the same bits, up to the
    rim of ``sampling_reach``. Positions outside are clamped to the rim; NaN positions give 0.

    Args:
        first_line: line of the images that is ``line`` 0.
        out: tensors that receive the samples, possibly with gaps between their rows; new ones where it is None.

    Returns:
        ``(rows, columns, channels)`` of each image, in its dtype.

    Raises:
        ValueError: the positions extend over more than 8192 px; sample tile by tile.
    """
    if out is None:
        out = [image.new_empty(*column.shape, image.shape[2]) for image in images]
    height, width, _ = images[0].shape
    # OpenCV reads what it needs of a whole image; the others get the part that the positions need.
    opencv = sampling.resampler == "opencv"
    whole = opencv and sampling.coarser == (1.0, 1.0) and max(height, width) <= _LARGEST_REMAPPED
    lines = _WindowPositions.of(line, height, first_line, whole=whole)
    columns = _WindowPositions.of(column, width, whole=whole)
    if lines is None or columns is None:
        for samples in out:
            samples.zero_()
        return out
    windows = [_smoothed_window(image, (lines.window, columns.window), sampling.coarser) for image in images]
    sample = _sample_by_remap if opencv else _sample_by_grid
    sample(windows, columns.position, lines.position, sampling.interpolation, out)
    return out


def sampling_reach(coarser: float) -> int:
    """Pixels beside a position that its value depends on, where samples lie ``coarser`` pixels apart."""
    return _REACH + smoothing_radius(coarser)


@dataclass(frozen=True)
class _WindowPositions:
    """Positions along one axis of an image, float32, counted from the start of the window that they need."""

    position: Tensor
    window: range

    @classmethod
    def of(cls, position: Tensor, size: int, first: int = 0, *, whole: bool = False) -> "_WindowPositions | None":
        """The window of an axis of ``size`` px and the positions in it; None where all positions are NaN.

        Args:
            position: counted from ``first``; NaN becomes a position outside of the window.
            whole: the window is the whole axis where this contains the positions and their reach.
        """
        values = position.numpy()  # NumPy's reductions skip NaN, torch's would need copies without NaN
        low, high = (float(end.reduce(values, axis=None)) for end in (np.fmin, np.fmax))
        if math.isnan(low):
            return None
        has_nan = math.isnan(position.sum())
        if low < -first or high > size - 1 - first:
            position = position.clamp(-first, size - 1 - first)
            low, high = (min(max(end, -first), size - 1 - first) for end in (low, high))
        start, stop = math.floor(low) - _REACH, math.ceil(high) + _REACH + 1
        if stop - start > _LARGEST_WINDOW:
            raise ValueError(f"positions: expected a spread of at most {_LARGEST_WINDOW} px, got {stop - start}")
        if whole and position.dtype == torch.float32 and start >= -first and stop <= size - first:
            start, stop = -first, size - first
        if start != 0:
            position = position - start  # exact in single precision too: only larger positions lose whole pixels
        if position.dtype != torch.float32:
            position = (position * PIXEL_PARTS).round_().div_(PIXEL_PARTS).to(torch.float32)
        return cls(position.nan_to_num(nan=_OUTSIDE) if has_nan else position, range(first + start, first + stop))


def _smoothed_window(image: Tensor, window: tuple[range, range], coarser: tuple[float, float]) -> Tensor:
    """A window of an image, its edge repeated outside; smoothed and float32 where samples are coarser."""
    for axis, (part, spacing) in enumerate(zip(window, coarser, strict=True)):
        radius, length = smoothing_radius(spacing), image.shape[axis]
        low, high = part.start - radius, part.stop + radius
        inside = image.narrow(axis, max(low, 0), min(high, length) - max(low, 0))
        image = _padded(inside, axis, max(-low, 0), max(high - length, 0))
    for axis, spacing in enumerate(coarser):
        image = smoothed(image, axis, spacing)
    return image


def _padded(image: Tensor, axis: int, before: int, after: int) -> Tensor:
    """An image whose first and last line (axis 0) or column (axis 1) are repeated."""
    if before == after == 0:
        return image
    first, last = image.narrow(axis, 0, 1), image.narrow(axis, image.shape[axis] - 1, 1)
    return torch.cat([first.repeat_interleave(before, axis), image, last.repeat_interleave(after, axis)], dim=axis)


def _sample_by_grid(
    windows: Sequence[Tensor], column: Tensor, line: Tensor, mode: Interpolation, out: Sequence[Tensor]
) -> None:
    # Instead of kornia's remap: its samples are off by up to 1e-4 of the values, depend on the strip, and take 1.2 to
    # 1.4 times as long. With a power of two of intervals, grid_sample's conversion from a normalised position back to
    # pixels rounds nothing.
    (height, width), channels = windows[0].shape[:2], [window.shape[2] for window in windows]
    intervals = [2 ** math.ceil(math.log2(size - 1)) for size in (width, height)]
    # Values beyond the windows are never read and need no initialisation.
    source = column.new_empty(sum(channels), intervals[1] + 1, intervals[0] + 1)
    for part, window in zip(source.split(channels), windows, strict=True):
        part[:, :height, :width] = window.movedim(-1, 0)
    grid = torch.empty(2, *column.shape)
    for axis, position, size in zip(grid, (column, line), intervals, strict=True):
        torch.mul(position, PIXEL_PARTS, out=axis).round_().mul_(2 / (PIXEL_PARTS * size)).sub_(1)
    at = grid.movedim(0, -1)[None]
    sampled = F.grid_sample(source[None], at, mode=mode, padding_mode="zeros", align_corners=True)[0]
    for part, samples in zip(sampled.split(channels), out, strict=True):
        _store(part, samples.movedim(-1, 0))


def _sample_by_remap(
    windows: Sequence[Tensor], column: Tensor, line: Tensor, mode: Interpolation, out: Sequence[Tensor]
) -> None:
    def remap(window: Tensor, into: np.ndarray | None = None) -> np.ndarray:
        maps = column.numpy(), line.numpy()
        return cv2.remap(window.numpy(), *maps, _CV2_MODES[mode], dst=into, borderMode=cv2.BORDER_CONSTANT)

    for window, samples in zip(windows, out, strict=True):
        if window.dtype == samples.dtype:
            remap(window, samples.numpy())
        else:
            _store(torch.from_numpy(remap(window)).view(samples.shape), samples)


def _store(sampled: Tensor, out: Tensor) -> None:
    """Write samples into a tensor of any dtype, rounded and clamped to its range."""
    if sampled.dtype != out.dtype and not out.dtype.is_floating_point:
        sampled = sampled.round_().clamp_(0.0, float(torch.iinfo(out.dtype).max)).to(out.dtype)
    out.copy_(sampled)
