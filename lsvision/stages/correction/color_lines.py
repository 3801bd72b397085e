"""Where the colours of a surface were taken: red, green and blue of a trilinear sensor look at different lines.

The depth of a scan is that of its green lines. Another colour, which looks at the plane Y = s z / z0, sees the same
point Y / n2 of travel later and in another column (``ProductFrame.plane_y``, ``shifted_column``).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from lsvision.geometry import ProductFrame, Rectification, color_rows, color_shift, registered_rows
from lsvision.image.column_map import ColumnMap
from lsvision.image.missing import missing_mask, missing_near
from lsvision.image.resampling import Sampling, sample_image, sampling_reach
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.locate import SeenCells
from lsvision.types import Scan

_NEARER = 0.1  # of z0: how much nearer or further than it surfaces may lie, at most
_COARSE_FROM = 1.25  # distance of cells, in pixels, from which on smoothing does more good than harm


@dataclass(frozen=True)
class ColorLines:
    """How to sample the colours of consecutive scan lines.

    Attributes:
        start: the first of the lines.
        image_range: the lines of the image that ``sample`` needs, first and end.
        sampling: how they are interpolated.
        shift_mm: where each colour looks along Y at z0, beyond green. rows: ``(channels, lines)``, float64: the image
            row in which a colour shows what green shows at z0 on each line. Both are None where all colours look at
            one line.
        registered: rows by which the camera has shifted each colour: row less ``registered`` is the line that it was
            taken on.
        raw_columns: where the columns of the ideal left image, in which cells are located, lie in the raw one; None
            where the image is rectified.
    """

    frame: ProductFrame
    start: int
    image_range: tuple[int, int]
    sampling: Sampling
    shift_mm: Tensor | None = None
    rows: Tensor | None = None
    registered: Sequence[float] = ()
    raw_columns: ColumnMap | None = None

    def sample(self, image: Tensor, seen: SeenCells, in_image: Tensor, out: Tensor) -> None:
        """Write the colours of cells, ``(rows, columns, channels)``, to ``out``.

        Args:
            image: the lines ``image_range`` of the left image. in_image: the cells' columns there.
        """
        if self.shift_mm is None or self.rows is None:
            first_line = seen.first_line - self.image_range[0]
            sample_image(image, in_image, seen.line, self.sampling, first_line=first_line, out=out)
            return
        begin = seen.first_line - self.start
        base = seen.line.nan_to_num().floor().clamp(-begin, self.rows.shape[1] - 2 - begin)
        part, base = (seen.line - base).double(), base.long() + begin
        column, line = seen.column.double(), seen.line.double() + seen.first_line
        z = self.frame.depth(column, seen.relief.double(), line)
        for channel, (shift_mm, rows) in enumerate(zip(self.shift_mm, self.rows - self.image_range[0], strict=True)):
            row, seen_at, into = torch.lerp(rows[base], rows[base + 1], part), column, torch.empty_like(out[..., :1])
            if shift_mm != 0:
                moved_mm, beside = self.frame.plane_y(shift_mm, z), self.image_range[0] - self.registered[channel]
                taken = line + (row + beside - line) * (moved_mm / shift_mm)
                row, seen_at = taken - beside, self.frame.shifted_column(column, z, moved_mm, (line, taken))
            sample_image(image[..., [channel]], self.in_image(seen_at), row, self.sampling, out=into)
            out[..., [channel]] = into

    def in_image(self, column: Tensor) -> Tensor:
        """Columns of the image that the camera took, px."""
        return column if self.raw_columns is None else self.raw_columns(column)


def sampling_for(config: CorrectionConfig, spacing: tuple[float, float]) -> Sampling:
    """How colours are interpolated for cells that lie ``spacing`` lines and columns of the scan apart."""
    lines, columns = (distance if distance >= _COARSE_FROM else 1.0 for distance in spacing)
    return Sampling(config.interpolation, config.resampler, (lines, columns))


def color_lines(scan: Scan, frame: ProductFrame, lines: tuple[int, int], sampling: Sampling) -> ColorLines:
    """Colours of the lines ``lines[0]..lines[1]-1``."""
    reach = sampling_reach(sampling.coarser[0])
    shift = color_shift(scan)
    rectification = Rectification.of(scan.raw_rig)
    raw_columns = None if rectification is None else ColumnMap.of(rectification.raw_left_columns)
    if shift is None:
        image_range = max(lines[0] - reach, 0), min(lines[1] + reach, scan.lines)
        return ColorLines(frame, lines[0], image_range, sampling, raw_columns=raw_columns)
    shift_mm, rows = shift * scan.travel.line_pitch_mm, color_rows(scan, frame, lines, shift)
    registered = registered_rows(scan, shift)
    beside = _beside(rows, torch.arange(*lines), registered)
    first = math.floor(float((rows - beside).min())) - reach
    last = math.ceil(float((rows + beside).max())) + reach + 1
    image_range = min(max(first, 0), scan.lines - 1), max(min(last, scan.lines), 1)
    return ColorLines(frame, lines[0], image_range, sampling, shift_mm, rows, registered.tolist(), raw_columns)


def lines_without_colors(scan: Scan, frame: ProductFrame, sampling: Sampling) -> Bool[Tensor, " lines"]:
    """The lines of a scan of which some colour would be interpolated from missing lines of the image."""
    lines, shift = torch.arange(scan.lines), color_shift(scan)
    near = missing_near(missing_mask(scan.left, lines), sampling_reach(sampling.coarser[0]))
    if shift is None:
        return near
    rows = color_rows(scan, frame, (0, scan.lines), shift)
    beside = _beside(rows, lines, registered_rows(scan, shift))
    ends = (rows - beside).floor(), (rows + beside).ceil()
    lower, upper = (row.long().clamp(0, scan.lines - 1) for row in ends)
    return (near[lower] | near[upper]).any(0)


def _beside(rows: Tensor, lines: Tensor, registered: Tensor) -> Tensor:
    """Rows by which what a colour shows of surfaces nearer or further than z0 may lie beside ``rows``, at most."""
    return _NEARER * (rows - registered[:, None] - lines).abs()
