"""What a product is made of: its grid, and strips of it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor


@dataclass(frozen=True)
class ProductGrid:
    """Cells of a product: cell (row, column) lies at q_y = origin_y + row·pitch, q_x = origin_x + column·pitch, mm."""

    rows: int
    columns: int
    pitch_mm: float
    origin_y_mm: float
    origin_x_mm: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @property
    def origin_mm(self) -> tuple[float, float]:
        """(q_y, q_x) of the centre of cell (0, 0)."""
        return self.origin_y_mm, self.origin_x_mm

    def q_x(self, columns: slice) -> Float[Tensor, " columns"]:
        """Places of a range of columns across the motion, mm, float64."""
        return self.origin_x_mm + self.pitch_mm * torch.arange(columns.start, columns.stop).double()

    def q_y(self, row: int) -> float:
        """Place of a row along the motion, mm."""
        return self.origin_y_mm + self.pitch_mm * row


@dataclass(frozen=True)
class ProductStrip:
    """Consecutive rows of a product, the first of which is ``row``.

    Attributes:
        color: in the scan's dtype.
        height: float32, mm towards the cameras from the middle of the plane of zero disparity, NaN where not measured.
        valid: where the height was measured.
        source: (line, column) of the scan that the colour came from, NaN where no line saw the cell; float32, for long
            scans float64.
        sigma: float32, mm, standard deviations of (q_x, q_y, q_z), where they were asked for.
    """

    row: int
    color: Shaped[Tensor, "rows columns channels"]
    height: Float[Tensor, "rows columns"]
    valid: Bool[Tensor, "rows columns"]
    source: Float[Tensor, "rows columns 2"]
    sigma: Float[Tensor, "rows columns 3"] | None = None
