"""Where the columns of a resampled image lie in its source."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_LEAST_DEGREE, _MOST_DEGREE = 3, 15  # of the polynomial
_LEFT_PX = 1e-4  # that it may leave: half of what single precision does


@dataclass(frozen=True)
class ColumnMap:
    """Where the columns of a resampled image lie in its source, px: a polynomial, as a lens has no steps.

    From a table, each place takes two reads from scattered memory, and four times as long.

    Attributes:
        width: columns of the resampled image.
        powers: of the place less the column, by powers of the column from -1 to 1 over the line.
    """

    width: int
    powers: tuple[float, ...]

    @classmethod
    def of(cls, places: Float[Tensor, " width"]) -> "ColumnMap":
        """That of places of all columns, float64, met to 1/10 000 px."""
        column = torch.linspace(-1, 1, len(places), dtype=places.dtype)
        moved = places - torch.arange(len(places), dtype=places.dtype)
        for degree in range(_LEAST_DEGREE, _MOST_DEGREE + 1):
            terms = column[:, None] ** torch.arange(degree + 1)
            found = torch.linalg.lstsq(terms, moved[:, None]).solution
            if float((terms @ found - moved[:, None]).abs().max()) < _LEFT_PX:
                break
        return cls(len(places), tuple(found[:, 0].tolist()))

    def __call__(self, column: Float[Tensor, "*cells"]) -> Float[Tensor, "*cells"]:
        """Columns of the source, px, in the dtype of ``column``; NaN of NaN."""
        x = column * (2.0 / (self.width - 1)) - 1.0
        moved = torch.full_like(x, self.powers[-1])
        for power in reversed(self.powers[:-1]):
            moved.mul_(x).add_(power)  # two roundings on every processor: no bit depends on where a tile ends
        return moved.add_(column)
