"""How much of a product was measured: the number of its valid cells and the range of their heights."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class MeasuredCells:
    """Number of measured cells and the range of their heights, mm; the range is empty, from inf to -inf, for none."""

    count: int = 0
    lowest_mm: float = math.inf
    highest_mm: float = -math.inf

    @classmethod
    def of(cls, height: Float[Tensor, "rows columns"], valid: Bool[Tensor, "rows columns"]) -> "MeasuredCells":
        """The measured cells of some rows."""
        measured = height[valid]
        if not measured.numel():
            return cls()
        return cls(measured.numel(), float(measured.min()), float(measured.max()))

    @classmethod
    def total(cls, parts: Iterable["MeasuredCells"]) -> "MeasuredCells":
        """The measured cells of several parts together."""
        whole = cls()
        for part in parts:
            whole = cls(
                whole.count + part.count,
                min(whole.lowest_mm, part.lowest_mm),
                max(whole.highest_mm, part.highest_mm),
            )
        return whole
