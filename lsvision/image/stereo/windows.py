"""Statistics over a square window around each block of a map, of the blocks that have a value."""

from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Windows:
    """Square windows of ``size`` blocks a side.

    Args:
        weight: 1 for valid blocks, 0 for the others.
        count: valid blocks within each window; 0.5 instead of 0.
    """

    size: int
    weight: Float[Tensor, "rows columns"]
    count: Float[Tensor, "rows columns"]

    @classmethod
    def over(cls, valid: Bool[Tensor, "rows columns"], size: int) -> "Windows":
        """Windows around each block of which only the valid ones count."""
        weight = valid.to(torch.float32)
        return cls(size, weight, window_sum(weight, size).clamp_(min=0.5))

    def mean(self, values: Float[Tensor, "lines width"]) -> Float[Tensor, "rows columns"]:
        """Mean over each window of a map with a value for each block or for each pixel."""
        return window_sum(self.reduced(values) * self.weight, self.size).div_(self.count)

    def reduced(self, values: Float[Tensor, "lines width"]) -> Float[Tensor, "rows columns"]:
        """The mean over each block of a map with a value for each block or for each pixel."""
        rows, columns = self.weight.shape
        if values.shape == self.weight.shape:
            return values
        return torch.from_numpy(cv2.resize(values.numpy(), (columns, rows), interpolation=cv2.INTER_AREA))

    def covariance(
        self,
        a: Float[Tensor, "lines width"],
        b: Float[Tensor, "lines width"],
        mean_a: Float[Tensor, "rows columns"],
        mean_b: Float[Tensor, "rows columns"],
    ) -> Float[Tensor, "rows columns"]:
        """Covariance over each window of two maps from their means: mean(a b) - mean(a) mean(b)."""
        return self.mean(a * b).addcmul_(mean_a, mean_b, value=-1)


def window_sum(values: Float[Tensor, "rows columns"], size: int) -> Float[Tensor, "rows columns"]:
    """Sum over the square window around each value, at the rim over the part of it within the map."""
    return torch.from_numpy(
        cv2.boxFilter(values.numpy(), -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
    )


def row_window_sum(values: Float[Tensor, "lines width"], size: int) -> Float[Tensor, "lines width"]:
    """Sum over a window along the line around each value, at the rim over the part of it within the line."""
    return torch.from_numpy(
        cv2.boxFilter(values.numpy(), -1, (size, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    )
