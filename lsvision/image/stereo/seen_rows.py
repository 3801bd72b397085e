"""Which rows of each column both images of a pair show; the others lie beyond the scan in one of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.resampled import ResampledImage
from lsvision.types import LineImage

_BETWEEN_PARTNERS = 2  # rows by which the ends of two partners may differ


@dataclass(frozen=True)
class SeenRows:
    """Rows ``first``..``stop - 1`` of each column, counted from the first one that is matched.

    What lies beyond matches nowhere. It would be searched for in vain, and count as a step of the surface.
    """

    first: Int[Tensor, " width"]
    stop: Int[Tensor, " width"]

    @classmethod
    def of(cls, left: LineImage, right: LineImage, rows: range, shift: int) -> "SeenRows | None":
        """Those of two images; None where both show all of them.

        Args:
            rows: of the left image. shift: by how many rows later the right one is read.
        """
        if not (isinstance(left, ResampledImage) and isinstance(right, ResampledImage)):
            return None
        first, last = (
            of_both(left.ends[end], right.ends[end] - shift) - rows.start
            for end, of_both in enumerate((torch.maximum, torch.minimum))
        )
        if float(first.max()) <= 0 and float(last.min()) >= len(rows) - 1:
            return None
        first, stop = first.ceil().long() + _BETWEEN_PARTNERS, last.floor().long() + 1 - _BETWEEN_PARTNERS
        return cls(first.clamp(max=len(rows) - 1), torch.maximum(stop, first + 1))

    def beyond(self, values: Float[Tensor, "rows columns"], block: int, margin: int) -> Bool[Tensor, "rows columns"]:
        """Which of the values of blocks of ``block`` pixels a side lie beyond, or up to so many blocks beside that."""
        row, ends = torch.arange(len(values))[:, None], self._of_blocks(values, block)
        return (row < ends.first + margin) | (row >= ends.stop - margin)

    def extended(self, values: Float[Tensor, "rows columns"], block: int) -> Float[Tensor, "rows columns"]:
        """Values of blocks; those beyond become that of the nearest block of their column which does not lie there."""
        row, ends = torch.arange(len(values))[:, None], self._of_blocks(values, block)
        moved = ((row < ends.first.max()) | (row >= ends.stop.min()))[:, 0]
        nearest = torch.minimum(torch.maximum(row[moved], ends.first), ends.stop - 1)
        values = values.clone()
        values[moved] = values.gather(0, nearest)
        return values

    def _of_blocks(self, values: Tensor, block: int) -> "SeenRows":
        """The same of the blocks of a map, whose last ones may reach beyond the image."""
        column = (torch.arange(values.shape[1]) * block).clamp_(max=len(self.first) - 1)
        first = (self.first[column] // block).clamp(0, len(values) - 1)
        return SeenRows(first, torch.maximum((self.stop[column] // block).clamp(max=len(values)), first + 1))
