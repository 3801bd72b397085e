"""Cells of a product -> the places of the scan that saw them.

Two one-dimensional steps: along each line (``profiles``), then across the lines (here), because q_x and q_z of a sample
depend on its own line alone.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, object_pitch_mm
from lsvision.image.visibility import Seen, Surface, see_cells
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.grid import offset_range
from lsvision.stages.correction.profiles import ProfileReader
from lsvision.types import ProductGrid

# Lines missing between two from which on nothing counts as measured there; a camera that runs free misses a few.
_MISSED_LINES = 3


@dataclass(frozen=True)
class SeenCells:
    """What cells see, ``(rows, columns)``, NaN where no line saw them.

    Attributes:
        first_line: line of the scan that ``line`` is counted from; ``column`` is a column of the left image.
        relief: z0 - q_z, mm. measured: whether it was measured.
        depth_sigma: of the depth, mm, where the source of the depth knows it.
    """

    first_line: int
    line: Tensor
    column: Tensor
    relief: Tensor
    measured: Tensor
    depth_sigma: Tensor | None

    def part(self, rows: slice, columns: slice) -> "SeenCells":
        """Those of a range of rows and columns."""
        at = rows, columns
        sigma = None if self.depth_sigma is None else self.depth_sigma[at]
        return SeenCells(self.first_line, self.line[at], self.column[at], self.relief[at], self.measured[at], sigma)


def cell_spacing(frame: ProductFrame, grid: ProductGrid) -> tuple[float, float]:
    """Distance of neighbouring cells in the scan, in lines and in columns."""
    return grid.pitch_mm / frame.advance_mm, grid.pitch_mm / object_pitch_mm(frame.rig)


@dataclass(frozen=True)
class LineRange:
    """Consecutive scan lines from ``start`` on, and how far along the motion each lies, mm."""

    start: int
    along: Tensor

    @property
    def stop(self) -> int:
        """One past the last line."""
        return self.start + len(self.along)

    def reaching(self, low: float, high: float) -> "LineRange":
        """The lines that lie between low and high, mm along the motion, and two more at either end."""
        backwards = bool(self.along[0] > self.along[-1])
        ascending = self.along.flip(0) if backwards else self.along
        first, last = torch.searchsorted(ascending, ascending.new_tensor([low, high])).tolist()
        first, last = max(first - 2, 0), min(last + 2, len(ascending))
        if backwards:
            first, last = len(ascending) - last, len(ascending) - first
        return LineRange(self.start + first, self.along[first:last])


@dataclass(frozen=True)
class Locator:
    """Finds what the cells of a product see."""

    frame: ProductFrame
    grid: ProductGrid
    config: CorrectionConfig
    profiles: ProfileReader

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance of neighbouring cells in the scan, in lines and in columns."""
        return cell_spacing(self.frame, self.grid)

    def lines_of(self, rows: tuple[int, int], scan_lines: int) -> LineRange:
        """The scan lines that rows ``rows[0]..rows[1]-1`` of the product can come from, with some to spare."""
        low, high = offset_range(self.frame, self.grid, slice(0, self.grid.columns), self.config)
        q_y = torch.tensor([self.grid.q_y(rows[0]), self.grid.q_y(rows[1] - 1)], dtype=torch.float64)
        line = self.frame.line(torch.cat([q_y - low, q_y - high]))
        start = max(math.floor(float(line.min())) - 2, 0)
        stop = min(math.ceil(float(line.max())) + 3, scan_lines)
        return LineRange(start, self.frame.along(torch.arange(start, max(start, stop)).double()))

    def locate(self, lines: LineRange, rows: tuple[int, int], columns: slice) -> SeenCells | None:
        """What the cells of rows ``rows[0]..rows[1]-1`` see, along each column; None where no line reaches.

        Args:
            lines: those of ``lines_of``, loaded in ``profiles``.
        """
        low, high = offset_range(self.frame, self.grid, columns, self.config)
        near = lines.reaching(self.grid.q_y(rows[0]) - high, self.grid.q_y(rows[1] - 1) - low)
        if len(near.along) < 2:
            return None
        profiles, along = self.profiles.read(near.start, near.stop, columns), near.along
        backwards = self.frame.travel.transport == "reverse"
        if backwards:  # in the order of growing q_y
            along, profiles = along.flip(0), Seen.of([values.flip(0) for values in profiles.tensors()])
        seen = see_cells(self._surface(along, profiles, rows[0], columns), rows[1] - rows[0], dim=0)
        return SeenCells(
            first_line=near.start,
            line=(len(along) - 1) - seen.place if backwards else seen.place,
            column=seen.carried[0],
            relief=seen.height,
            measured=seen.measured,
            depth_sigma=seen.carried[1] if profiles.carried else None,
        )

    def _surface(self, along: Tensor, profiles: Seen, row: int, columns: slice) -> Surface:
        """Profiles of lines at ``along``, mm, as a surface over the rows from ``row`` on."""
        pitch, config = self.grid.pitch_mm, self.config
        lag = self.frame.lag(self.grid.q_x(slice(0, self.grid.columns)))
        cell = _snapped((along - lag[0] - self.grid.origin_y_mm) / pitch)
        shift = _snapped((lag[0] - lag[columns]) / pitch).float()
        part = torch.add((cell - cell.floor()).float()[:, None], shift)
        missed = (along.diff() / self.frame.advance_mm - 1)[:, None]  # lines that would have fitted between two
        step_mm = self.profiles.rule.largest_step_mm
        return Surface(
            whole=(cell.floor() - row).float(),
            part=part.add_(profiles.height, alpha=self.frame.q_y_per_relief / pitch),
            height=profiles.height,
            carried=(profiles.place, *profiles.carried),
            connected=(profiles.height.diff(dim=0).abs_() <= step_mm)  # false beside a hole
            .logical_and_(missed <= config.bridge_px),
            measured=(profiles.measured[1:] & profiles.measured[:-1]).logical_and_(missed <= _MISSED_LINES),
        )


def _snapped(cells: Tensor) -> Tensor:
    """Positions to a millionth of a cell, so that lines of equal travel stay at one place."""
    return (cells * 2**20).round() / 2**20
