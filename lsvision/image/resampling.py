"""Resampling of images at given positions, by ``grid_sample`` or by OpenCV."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from lsvision.image.tiling import PIXEL_PARTS

Interpolation = Literal["bilinear", "bicubic"]
Resampler = Literal["grid_sample", "opencv"]

# Rows and columns to sample at once: under grid_sample's, skewed by 3°, an image stays in the processor's cache; OpenCV
# sees to that itself.
SAMPLED_TILES: dict[Resampler, tuple[int, int]] = {"grid_sample": (128, 480), "opencv": (512, 480)}

_LARGEST_WINDOW = 8192
_LARGEST_REMAPPED = 32766  # what OpenCV counts pixels up to
_REACH = 2  # pixels that an interpolation looks at beside a position
_BEYOND = -16.0  # a position outside of any window, where nothing is
_TAIL = 3.0  # standard deviations at which a Gaussian is cut off
_CV2_MODES = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}


def sample_image(
    image: Tensor,
    column: Float[Tensor, "rows columns"],
    line: Float[Tensor, "rows columns"],
    mode: Interpolation,
    *,
    first_line: int = 0,
    coarser: tuple[float, float] = (1.0, 1.0),
    resampler: Resampler = "grid_sample",
    out: Tensor | None = None,
) -> Tensor:
    """Sample one image ``(lines, width, channels)``; see ``sample_images``."""
    options: dict[str, Any] = {"first_line": first_line, "coarser": coarser, "resampler": resampler}
    return sample_images((image,), column, line, mode, **options, out=None if out is None else (out,))[0]


def sample_images(
    images: Sequence[Tensor],
    column: Float[Tensor, "rows columns"],
    line: Float[Tensor, "rows columns"],
    mode: Interpolation,
    *,
    first_line: int = 0,
    coarser: tuple[float, float] = (1.0, 1.0),
    resampler: Resampler = "grid_sample",
    out: Sequence[Tensor] | None = None,
) -> Sequence[Tensor]:
    """Sample images ``(lines, width, channels)`` of one size at positions in px, all of them in one call.

    Positions are rounded to 1/2048 px: cut from a larger image, at any place, an image gives the same bits, up to the
    rim of ``sampling_reach``. Positions outside are clamped to the rim; NaN positions give 0.

    Args:
        first_line: of the images, that ``line`` is counted from.
        coarser: distance of neighbouring samples in lines and in columns; where it exceeds 1, the images are smoothed
            first, so that no detail finer than the samples turns into a false pattern.
        out: where the samples are put; made where it is None. Rows may lie apart.

    Returns:
        ``(rows, columns, channels)`` of each image, in its dtype.

    Raises:
        ValueError: the positions spread over more than 8192 px; sample tile by tile.
    """
    if out is None:
        out = [image.new_empty(*column.shape, image.shape[2]) for image in images]
    (height, width, _), opencv = images[0].shape, resampler == "opencv"
    whole = opencv and coarser == (1.0, 1.0) and max(height, width) <= _LARGEST_REMAPPED
    along, across = _Axis.of(line, height, first_line, whole=whole), _Axis.of(column, width, whole=whole)
    if along is None or across is None:
        for into in out:
            into.zero_()
        return out
    windows = [_window(image, along.window, across.window, coarser) for image in images]
    (_remap if opencv else _grid_sample)(windows, across.position, along.position, mode, out)
    return out


def sampling_reach(coarser: float) -> int:
    """Pixels beside a position that its value depends on, where samples lie ``coarser`` pixels apart."""
    return _REACH + _radius(coarser)


@dataclass(frozen=True)
class _Axis:
    """Positions on one axis of an image, float32, from the start of the window ``(start, stop)`` that they need."""

    position: Tensor
    window: tuple[int, int]

    @classmethod
    def of(cls, position: Tensor, size: int, first: int = 0, *, whole: bool = False) -> "_Axis | None":
        """From positions counted from ``first``; what is NaN comes to lie beyond the window. None where all are.

        With ``whole`` the window is all of the image where that holds enough.
        """
        low, high, gaps = _ends(position)
        if math.isnan(low):
            return None
        if low < -first or high > size - 1 - first:
            position = position.clamp(-first, size - 1 - first)
            low, high = (min(max(end, -first), size - 1 - first) for end in (low, high))
        start, stop = math.floor(low) - _REACH, math.ceil(high) + _REACH + 1
        if stop - start > _LARGEST_WINDOW:
            raise ValueError(f"positions: expected a spread of at most {_LARGEST_WINDOW} px, got {stop - start}")
        if whole and position.dtype == torch.float32 and start >= -first and stop <= size - first:
            start, stop = -first, size - first
        if start != 0:
            position = position - start  # exact in single precision too: whole pixels are taken off what is larger
        if position.dtype != torch.float32:
            position = (position * PIXEL_PARTS).round_().div_(PIXEL_PARTS).to(torch.float32)
        return cls(position.nan_to_num(nan=_BEYOND) if gaps else position, (first + start, first + stop))


def _ends(position: Tensor) -> tuple[float, float, bool]:
    """Least and greatest of what is not NaN, both NaN where all are; and whether any is.

    NumPy's reductions pass over NaN, torch's would need copies without.
    """
    values = position.numpy()
    low, high = (float(end.reduce(values, axis=None)) for end in (np.fmin, np.fmax))
    return low, high, math.isnan(position.sum())


def _put(sampled: Tensor, out: Tensor) -> None:
    """Samples into a tensor of any dtype, rounded and limited to what it holds."""
    if sampled.dtype != out.dtype and not out.dtype.is_floating_point:
        sampled = sampled.round_().clamp_(0.0, float(torch.iinfo(out.dtype).max)).to(out.dtype)
    out.copy_(sampled)


def _window(image: Tensor, lines: tuple[int, int], columns: tuple[int, int], coarser: tuple[float, float]) -> Tensor:
    """Part of an image, continued past its rim by its own edge; where samples are coarser, smoothed and float32."""
    for axis, (start, stop), spacing in ((0, lines, coarser[0]), (1, columns, coarser[1])):
        radius = _radius(spacing)
        low, high = start - radius, stop + radius
        inside = image.narrow(axis, max(low, 0), min(high, image.shape[axis]) - max(low, 0))
        image = _continued(inside, axis, max(-low, 0), max(high - image.shape[axis], 0))
    for axis, spacing in enumerate(coarser):
        image = _smoothed(image, axis, spacing)
    return image


def _continued(image: Tensor, axis: int, before: int, after: int) -> Tensor:
    """An image with its first and last line (axis 0) or column (axis 1) repeated."""
    if before == after == 0:
        return image
    shape = list(image.shape)
    edges = []
    for place, times in ((0, before), (image.shape[axis] - 1, after)):
        shape[axis] = times
        edges.append(image.narrow(axis, place, 1).expand(shape))
    return torch.cat([edges[0], image, edges[1]], dim=axis)


def _radius(coarser: float) -> int:
    return math.ceil(_TAIL * _sigma(coarser)) if coarser > 1 else 0


def _sigma(coarser: float) -> float:
    # A sample stands for a Gaussian of half its spacing; what the pixel's own width already blurs is taken off.
    return 0.5 * math.sqrt(coarser**2 - 1)


def _smoothed(image: Tensor, axis: int, coarser: float) -> Tensor:
    """Gaussian filter along an axis, without the radius at its ends; tap by tap, so that no bit depends on the size."""
    radius = _radius(coarser)
    if radius == 0:
        return image
    offset = torch.arange(-radius, radius + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (offset / _sigma(coarser)).square())
    taps = (weight / weight.sum()).tolist()
    image = image.to(torch.float32)
    length = image.shape[axis] - 2 * radius
    smooth = image.narrow(axis, 0, length) * taps[0]
    for start, tap in enumerate(taps[1:], start=1):
        smooth += image.narrow(axis, start, length) * tap
    return smooth


def _grid_sample(
    windows: Sequence[Tensor], column: Tensor, line: Tensor, mode: Interpolation, out: Sequence[Tensor]
) -> None:
    (height, width), channels = windows[0].shape[:2], [window.shape[2] for window in windows]
    # With a power of two of intervals, grid_sample's way from a normalised position back to pixels rounds nothing.
    intervals = [2 ** math.ceil(math.log2(size - 1)) for size in (width, height)]
    # What lies beyond the windows is never looked at, and need not be filled.
    source = column.new_empty(sum(channels), intervals[1] + 1, intervals[0] + 1)
    for part, window in zip(source.split(channels), windows, strict=True):
        part[:, :height, :width] = window.movedim(-1, 0)
    grid = torch.empty(2, *column.shape)
    for axis, position, size in zip(grid, (column, line), intervals, strict=True):
        torch.mul(position, PIXEL_PARTS, out=axis).round_().mul_(2 / (PIXEL_PARTS * size)).sub_(1)
    at = grid.movedim(0, -1)[None]
    sampled = F.grid_sample(source[None], at, mode=mode, padding_mode="zeros", align_corners=True)[0]
    for part, into in zip(sampled.split(channels), out, strict=True):
        _put(part, into.movedim(-1, 0))


def _remap(windows: Sequence[Tensor], column: Tensor, line: Tensor, mode: Interpolation, out: Sequence[Tensor]) -> None:
    maps = column.numpy(), line.numpy()
    for window, into in zip(windows, out, strict=True):
        options: dict[str, Any] = {"interpolation": _CV2_MODES[mode], "borderMode": cv2.BORDER_CONSTANT}
        if window.dtype == into.dtype:
            cv2.remap(window.numpy(), *maps, dst=into.numpy(), **options)
        else:
            _put(torch.from_numpy(cv2.remap(window.numpy(), *maps, **options)).view(into.shape), into)
