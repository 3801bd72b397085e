"""Where the colours of a surface were taken: red, green and blue of a trilinear sensor look at different lines.

The depth of a scan is that of its green lines. Another colour, which looks at the plane Y = s, sees the same point
s / n2 of travel later and in another column (``ProductFrame.shifted_column``).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from lsvision.geometry import ProductFrame, color_rows, color_shift, registered_rows
from lsvision.image.missing import missing_mask, missing_near
from lsvision.image.resampling import Sampling, sample_image, sampling_reach
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.locate import SeenCells
from lsvision.types import Scan

_COARSE_FROM = 1.25  # distance of cells, in pixels, from which on smoothing does more good than harm


@dataclass(frozen=True)
class ColorLines:
    """How to sample the colours of consecutive scan lines.

    Attributes:
        start: the first of the lines.
        image_range: the lines of the image that ``sample`` needs, first and end.
        sampling: how they are interpolated.
        shift_mm: where each colour looks along Y, beyond green. rows: ``(channels, lines)``, float64: the image row in
            which a colour shows what green shows on each line. Both are None where all colours look at one line.
        registered: rows by which the camera has shifted each colour: row less ``registered`` is the line that it was
            taken on.
    """

    frame: ProductFrame
    start: int
    image_range: tuple[int, int]
    sampling: Sampling
    shift_mm: Tensor | None = None
    rows: Tensor | None = None
    registered: Sequence[float] = ()

    def sample(self, image: Tensor, seen: SeenCells, out: Tensor) -> None:
        """Write the colours of cells, ``(rows, columns, channels)``, to ``out``.

        Args:
            image: the lines ``image_range`` of the left image.
        """
        if self.shift_mm is None or self.rows is None:
            first_line = seen.first_line - self.image_range[0]
            sample_image(image, seen.column, seen.line, self.sampling, first_line=first_line, out=out)
            return
        begin = seen.first_line - self.start
        base = seen.line.nan_to_num().floor().clamp(-begin, self.rows.shape[1] - 2 - begin)
        part, base = (seen.line - base).double(), base.long() + begin
        column, relief = seen.column.double(), seen.relief.double()
        line = seen.line.double() + seen.first_line
        for channel, (shift_mm, rows) in enumerate(zip(self.shift_mm, self.rows - self.image_range[0], strict=True)):
            row, into = torch.lerp(rows[base], rows[base + 1], part), torch.empty_like(out[..., :1])
            taken = row + (self.image_range[0] - self.registered[channel])
            shifted = self.frame.shifted_column(column, relief, shift_mm, (line, taken))
            sample_image(image[..., [channel]], shifted, row, self.sampling, out=into)
            out[..., [channel]] = into


def sampling_for(config: CorrectionConfig, spacing: tuple[float, float]) -> Sampling:
    """How colours are interpolated for cells that lie ``spacing`` lines and columns of the scan apart."""
    lines, columns = (distance if distance >= _COARSE_FROM else 1.0 for distance in spacing)
    return Sampling(config.interpolation, config.resampler, (lines, columns))


def color_lines(scan: Scan, frame: ProductFrame, lines: tuple[int, int], sampling: Sampling) -> ColorLines:
    """Colours of the lines ``lines[0]..lines[1]-1``."""
    reach = sampling_reach(sampling.coarser[0])
    shift = color_shift(scan)
    if shift is None:
        image_range = max(lines[0] - reach, 0), min(lines[1] + reach, scan.lines)
        return ColorLines(frame, lines[0], image_range, sampling)
    shift_mm, rows = shift * scan.travel.line_pitch_mm, color_rows(scan, frame, lines, shift)
    registered = registered_rows(scan, shift).tolist()
    first, last = math.floor(float(rows.min())) - reach, math.ceil(float(rows.max())) + reach + 1
    image_range = min(max(first, 0), scan.lines - 1), max(min(last, scan.lines), 1)
    return ColorLines(frame, lines[0], image_range, sampling, shift_mm, rows, registered)


def lines_without_colors(scan: Scan, frame: ProductFrame, sampling: Sampling) -> Bool[Tensor, " lines"]:
    """The lines of a scan of which some colour would be interpolated from missing lines of the image."""
    lines, shift = torch.arange(scan.lines), color_shift(scan)
    near = missing_near(missing_mask(scan.left, lines), sampling_reach(sampling.coarser[0]))
    if shift is None:
        return near
    rows = color_rows(scan, frame, (0, scan.lines), shift)
    lower, upper = (row.long().clamp(0, scan.lines - 1) for row in (rows.floor(), rows.ceil()))
    return (near[lower] | near[upper]).any(0)
