"""What was matched on the rows of a raw pair -> at the places of the samples of the ideal left image."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.image.column_shifts import ColumnShifts
from lsvision.image.sheared_rows import ShearedRows
from lsvision.stages.disparity.match import StripMatch


@dataclass(frozen=True)
class SampledMatch:
    """Disparity at some places, px: between the four samples around each, and the nearest one, with its sigma."""

    between: Float[Tensor, "lines columns"]
    nearest: Float[Tensor, "lines columns"]
    sigma: Float[Tensor, "lines columns"]


@dataclass(frozen=True)
class IdealLines:
    """Where the samples of the ideal left image lie among those that were matched.

    Samples are read by their number in memory, which takes half as long as a remap of the same places.

    Attributes:
        places: columns of the raw left image, px, float64. width: of that image. rows: of it, as it was matched.
    """

    places: Float[Tensor, " columns"]
    width: int
    rows: ShearedRows

    def sampled(self, match: StripMatch, first_row: int, lines: range, columns: slice) -> SampledMatch:
        """What was matched at the places of some lines in some columns; beyond the ends of a row those are repeated.

        Args:
            match: contiguous in memory. first_row: row that it begins with; it holds all rows that the lines lie on or
                between.
        """
        share, above = self._share[columns], self._share[columns] >= 0.5
        at = self._numbers(first_row, lines, columns)
        between = _between(_taken(match.disparity, at.upper), _taken(match.disparity, at.upper, 1), share)
        if at.part is None:
            near = at.upper + above
        else:
            lower = (_taken(match.disparity, at.upper, self.width + step) for step in (0, 1))
            between = _between(between, _between(next(lower), next(lower), share), at.part)
            near = at.upper + (above + (at.part >= 0.5) * self.width)
        return SampledMatch(between, _taken(match.disparity, near), _taken(match.sigma, near))

    def _numbers(self, first_row: int, lines: range, columns: slice) -> "_Numbers":
        """The numbers of the samples above and to the left of the places of some lines in some columns."""
        base, beyond = self._base[columns], -self.rows.first - first_row
        numbers = torch.arange(lines.start + beyond, lines.stop + beyond)[:, None] * self.width
        if self.rows.late_mm is None:  # rows are lines
            return _Numbers(numbers + base, None)
        if self._shifts is not None:
            return _Numbers(numbers + (self._shifts.whole[columns] * self.width + base), self._shifts.part[columns])
        row = self.rows.rows_after(first_row, lines, self._near[columns])
        whole = row.floor()
        return _Numbers(whole.long().mul_(self.width).add_(base), row.sub_(whole))

    @cached_property
    def _base(self) -> Int[Tensor, " columns"]:
        return self.places.floor().long().clamp(0, self.width - 2)

    @cached_property
    def _share(self) -> Float[Tensor, " columns"]:
        """Of the way from the sample at ``_base`` to the next one."""
        return (self.places - self._base).clamp(0, 1).float()

    @cached_property
    def _near(self) -> Int[Tensor, " columns"]:
        """Nearest columns, whose shear is taken: it changes by less than a hundredth of a line from one to the next."""
        return self.places.round().long().clamp(0, self.width - 1)

    @cached_property
    def _shifts(self) -> ColumnShifts | None:
        """By how many rows each column of a line lies after row line - ``rows.first``; None where that is uneven."""
        late = self.rows.late_lines
        return None if late is None else ColumnShifts.of(-late[self._near])


@dataclass(frozen=True)
class _Numbers:
    """Numbers of samples, as they lie in memory, and how far below them places lie; None where they lie on their row.

    One distance for each place, or for each column.
    """

    upper: Int[Tensor, "lines columns"]
    part: Float[Tensor, "*#lines columns"] | None


def _taken(values: Tensor, at: Tensor, later: int = 0) -> Tensor:
    """The values that lie so many later in memory than some numbers."""
    return values.view(-1)[later:].index_select(0, at.view(-1)).view(at.shape)


def _between(low: Tensor, high: Tensor, share: Tensor) -> Tensor:
    """What lies between two values; in steps that every processor rounds alike: no bit depends on where a tile ends."""
    return high.sub_(low).mul_(share).add_(low)
