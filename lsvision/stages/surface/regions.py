"""Connected places of a mask that is seen strip by strip, and sums over each of them.

A region that crosses the border of strips is one. Strips begin at fixed places, and the sums over a region's parts are
added in the order of the strips: no bit depends on anything else.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

SUMS = ("cells", "value", "value_row", "value_cell", "row", "cell", "row_row", "row_cell", "cell_cell", "contrast")
FITS = 5  # values of paraboloids at the place of the highest ratio
PEAKS = ("ratio", "peak_value", "peak_row", "peak_cell", "peak_contrast", *(f"fit_{index}" for index in range(FITS)))
ENDS = ("first_row", "last_row", "first_cell", "last_cell")


@dataclass(frozen=True)
class Strip:
    """Where a strip departs, and by how much; ``row`` is its first, ``fitted`` makes the fits at (row, cell)."""

    row: int
    mask: Bool[Tensor, "rows cells"]
    ratio: Float[Tensor, "rows cells"]
    value: Float[Tensor, "rows cells"]
    contrast: Float[Tensor, "rows cells"]
    fitted: Callable[[Int[Tensor, " places"], Int[Tensor, " places"]], Float[Tensor, "fits places"]]


@dataclass
class Regions:
    """The regions found so far: a table of their parts, and which parts touch."""

    parts: list[Mapping[str, Tensor]] = field(default_factory=list)
    touching: list[Int[Tensor, "2 pairs"]] = field(default_factory=list)
    _count: int = 0
    _last: Int[Tensor, " cells"] | None = None

    def add(self, strip: Strip) -> None:
        """Take in the strip that follows."""
        count, found = cv2.connectedComponents(strip.mask.numpy().astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
        labels = torch.from_numpy(found).long()
        numbered = torch.where(labels > 0, labels - 1 + self._count, -1)
        if self._last is not None and len(labels):
            self.touching.append(_pairs(self._last, numbered[0]))
        if count > 1:
            self.parts.append(_sums(strip, labels, count - 1))
        self._count, self._last = self._count + count - 1, numbered[-1]

    def table(self) -> dict[str, Float[Tensor, " regions"]]:
        """Sums, peaks and ends of whole regions, in the order in which they begin."""
        names = (*SUMS, *PEAKS, *ENDS)
        if not self.parts:
            return {name: torch.zeros(0, dtype=torch.float64) for name in names}
        parts = {name: torch.cat([part[name] for part in self.parts]) for name in names}
        root = _roots(self._count, self.touching)
        first, member = torch.unique(root, return_inverse=True)
        return _merged(parts, _Members(member, len(first)))


@dataclass(frozen=True)
class _Members:
    """Things that belong to ``count`` groups, and what the groups make of their values."""

    group: Int[Tensor, " members"]
    count: int

    def total(self, values: Tensor) -> Float[Tensor, " groups"]:
        """Sums, added in the order of the members."""
        return torch.bincount(self.group, weights=values, minlength=self.count)

    def least(self, values: Tensor) -> Tensor:
        """Smallest values."""
        return values.new_zeros(self.count).scatter_reduce(0, self.group, values, "amin", include_self=False)

    def most(self, values: Tensor) -> Tensor:
        """Largest values."""
        return values.new_zeros(self.count).scatter_reduce(0, self.group, values, "amax", include_self=False)

    def highest(self, values: Tensor) -> Int[Tensor, " groups"]:
        """Which member has the largest value; the first of several."""
        number = torch.arange(len(values))
        return self.least(torch.where(values == self.most(values)[self.group], number, len(values)))


def _sums(strip: Strip, labels: Int[Tensor, "rows cells"], count: int) -> dict[str, Tensor]:
    """The table of a strip's own regions."""
    row, cell = labels.nonzero(as_tuple=True)
    of = _Members(labels[row, cell] - 1, count)
    ratio, value, contrast = (plane[row, cell].double() for plane in (strip.ratio, strip.value, strip.contrast))
    y, x = (row + strip.row).double(), cell.double()
    summed = (torch.ones_like(value), value, value * y, value * x, y, x, y * y, y * x, x * x, contrast.nan_to_num())
    peak = of.highest(ratio)
    return {
        **{name: of.total(values) for name, values in zip(SUMS, summed, strict=True)},
        **{name: values[peak] for name, values in zip(PEAKS[:5], (ratio, value, y, x, contrast), strict=True)},
        **dict(zip(PEAKS[5:], strip.fitted(row[peak], cell[peak]), strict=True)),
        **dict(zip(ENDS, (of.least(y), of.most(y), of.least(x), of.most(x)), strict=True)),
    }


def _pairs(above: Int[Tensor, " cells"], below: Int[Tensor, " cells"]) -> Int[Tensor, "2 pairs"]:
    """Regions of two neighbouring rows that touch, by a side or a corner."""
    near = [
        torch.stack([above, below]),
        torch.stack([above[1:], below[:-1]]),
        torch.stack([above[:-1], below[1:]]),
    ]
    pairs = torch.cat(near, dim=1)
    return pairs[:, (pairs >= 0).all(0)].unique(dim=1)


def _roots(count: int, touching: list[Tensor]) -> Int[Tensor, " parts"]:
    """The first part of the region that every part belongs to."""
    parent = list(range(count))

    def root(part: int) -> int:
        """The part that stands for all that are known to touch this one; paths to it are halved on the way."""
        while parent[part] != part:
            parent[part] = parent[parent[part]]
            part = parent[part]
        return part

    for pairs in touching:
        for one, other in pairs.T.tolist():
            low, high = sorted((root(one), root(other)))
            parent[high] = low
    return torch.tensor([root(part) for part in range(count)], dtype=torch.long)


def _merged(parts: Mapping[str, Tensor], of: _Members) -> dict[str, Tensor]:
    """Tables of parts -> of the regions they are members of."""
    peak = of.highest(parts["ratio"])
    return {
        **{name: of.total(parts[name]) for name in SUMS},
        **{name: parts[name][peak] for name in PEAKS},
        **{name: (of.least if name.startswith("first") else of.most)(parts[name]) for name in ENDS},
    }
