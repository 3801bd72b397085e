"""Where the colours of a surface were taken: red, green and blue of a trilinear sensor look at different lines.

The depth of a scan is that of its green lines. A camera's colour c that looks at the plane Y = s sees the point that
green sees at (x, z) and travel y when the object has moved on by s / n2 of travel, displaced by s (n1, n3) / n2.
"""

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from lsvision.geometry import line_at, product_axes, travel_at
from lsvision.image.resampling import Interpolation, Resampler, sample_image, sampling_reach
from lsvision.types import Motion, Rig, Scan

_GREEN = 1
_COARSE_FROM = 1.25  # distance of cells, in pixels, from which on smoothing does more good than harm


@runtime_checkable
class Sampling(Protocol):
    """How colours are interpolated."""

    @property
    def interpolation(self) -> Interpolation:
        """Bilinear or bicubic."""
        ...

    @property
    def resampler(self) -> Resampler:
        """The library that does it."""
        ...


@dataclass(frozen=True)
class ColorLines:
    """How to sample the colours of some scan lines, the first of which is ``start``.

    ``shift_mm`` is where each colour looks along Y beyond green, ``rows (channels, lines)`` the image row, float64, in
    which a colour shows what green shows in each of the lines; both None where all colours look at one line.
    ``image_range`` are the image's lines to be given to ``sample``.
    """

    rig: Rig
    motion: Motion
    start: int
    image_range: tuple[int, int]
    coarser: tuple[float, float]
    shift_mm: Tensor | None = None
    rows: Tensor | None = None

    def sample(
        self, image: Tensor, first_line: int, line: Tensor, column: Tensor, height: Tensor, how: Sampling, out: Tensor
    ) -> None:
        """Put into ``out`` the colours of what green sees at a line and column of the scan and a height, mm.

        Args:
            image: the lines ``image_range`` of the left image. line: counted from ``first_line`` of the scan.
            out: ``(rows, columns, channels)``.
        """
        if self.shift_mm is None or self.rows is None:
            self._sample(image, column, line, how, out, first_line - self.image_range[0])
            return
        begin = first_line - self.start
        base = line.nan_to_num().floor().clamp(-begin, self.rows.shape[1] - 2 - begin)
        part, base = (line - base).double(), base.long() + begin
        for channel, (shift, rows) in enumerate(zip(self.shift_mm, self.rows - self.image_range[0], strict=True)):
            row, into = torch.lerp(rows[base], rows[base + 1], part), torch.empty_like(out[..., :1])
            self._sample(image[..., [channel]], self._column(column, height, shift), row, how, into)
            out[..., [channel]] = into

    def _sample(
        self, image: Tensor, column: Tensor, line: Tensor, how: Sampling, out: Tensor, first_line: int = 0
    ) -> None:
        options: dict[str, Any] = {"coarser": self.coarser, "resampler": how.resampler, "first_line": first_line}
        sample_image(image, column, line, how.interpolation, **options, out=out)

    def _column(self, column: Tensor, height: Tensor, shift: Tensor) -> Tensor:
        """Column at which a colour sees what green sees in another."""
        rig, n, axes = self.rig, self.motion.n, product_axes(self.motion.n)
        offset = column.double() - rig.principal_left_px
        z = (rig.zero_disparity_mm - height.double()) / (offset / rig.focal_length_px * axes[2, 0] + axes[2, 2])
        x = offset * z + rig.focal_length_px * shift * n[0] / n[1]
        return rig.principal_left_px + x / (z + shift * n[2] / n[1])


def color_lines(scan: Scan, motion: Motion, lines: tuple[int, int], spacing: tuple[float, float]) -> ColorLines:
    """Colours of the lines ``lines[0]..lines[1]-1``.

    Args:
        spacing: distance of the samples in lines and columns.
    """
    coarser = (_smoothed_over(spacing[0]), _smoothed_over(spacing[1]))
    reach = sampling_reach(coarser[0])
    shift = torch.tensor(scan.rig.color_spacing_lines, dtype=torch.float64)
    shift = shift - shift[_GREEN]
    if scan.left.shape[2] == 1 or not bool(shift.any()):
        image_range = max(lines[0] - reach, 0), min(lines[1] + reach, scan.lines)
        return ColorLines(scan.rig, motion, lines[0], image_range, coarser)
    travel, line = scan.travel, torch.arange(*lines, dtype=torch.float64)
    shift_mm = shift * travel.line_pitch_mm
    rows = line_at(travel, travel_at(travel, line) - shift_mm[:, None] / motion.n[1])
    if scan.color_registered:  # the camera has put each colour that many rows further
        rows = rows + (-1.0 if travel.transport == "reverse" else 1.0) * shift[:, None]
    first, last = math.floor(float(rows.min())) - reach, math.ceil(float(rows.max())) + reach + 1
    image_range = min(max(first, 0), scan.lines - 1), max(min(last, scan.lines), 1)
    return ColorLines(scan.rig, motion, lines[0], image_range, coarser, shift_mm, rows)


def _smoothed_over(spacing: float) -> float:
    return spacing if spacing >= _COARSE_FROM else 1.0
