"""The lines on which edges are looked at: straight lines and means over them."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

_STEPS = 10  # of a robust line
_TAIL = 3.0  # standard deviations, at which the Gaussian is cut off


@dataclass(frozen=True)
class EdgeLines:
    """The lines on which edges are looked at.

    Attributes:
        motion: what their profile shows of the object's motion, by line; δx is what edges have found of it.
        along: travel, from the middle of the lines, over its largest. used: which lines show the object.
        advance_mm: of the object by line.
    """

    motion: Float[Tensor, "lines 4"]
    along: Float[Tensor, " lines"]
    used: Bool[Tensor, " lines"]
    advance_mm: float

    @property
    def design(self) -> Float[Tensor, "lines 2"]:
        """Mean and trend."""
        return torch.stack([torch.ones_like(self.along), self.along], 1)

    def displaced(self, dx: Float[Tensor, " lines"]) -> Float[Tensor, "lines 4"]:
        """The motion with a displacement sideways."""
        return torch.cat([dx[:, None], self.motion[:, 1:]], 1)

    def straight(
        self, values: Float[Tensor, "edges lines"], weight: Float[Tensor, "edges lines"]
    ) -> Float[Tensor, "edges 2"]:
        """Mean and trend of values, by weighted least squares over the used lines."""
        weight = weight * self.used
        heavy = weight[..., None] * self.design
        normal = self.design.T @ heavy
        right = (heavy * values[..., None]).sum(-2)
        ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None] * torch.eye(2).to(normal)
        return torch.linalg.solve(normal + ridge, right)

    def smooth(
        self, values: Float[Tensor, "*batch lines"], weight: Float[Tensor, "*batch lines"], length_mm: float
    ) -> Float[Tensor, "*batch lines"]:
        """Weighted means over neighbouring used lines."""
        weight = weight * self.used
        both = torch.stack([weight * values, weight])
        sigma = length_mm / self.advance_mm
        offset = torch.arange(-round(_TAIL * sigma), round(_TAIL * sigma) + 1).to(values)
        kernel = torch.exp(-0.5 * (offset / sigma).square())
        flat = F.conv1d(both.flatten(0, -2)[:, None], kernel[None, None], padding=len(offset) // 2)[:, 0]
        total, weights = flat.view_as(both)
        return total / weights.clamp(min=torch.finfo(values.dtype).tiny)


def robust_straight(
    place: Float[Tensor, "edges lines"], lines: EdgeLines, there: Float[Tensor, "edges lines"]
) -> Float[Tensor, "edges 2"]:
    """Mean and trend of places that are off on some lines: by weights that shrink with the distance (Cauchy).

    Args:
        there: one where an edge shows, else zero.
    """
    weight = there
    for _ in range(_STEPS):
        line = lines.straight(place, weight)
        off = (place - line @ lines.design.T).abs()
        usual = off.masked_fill(there * lines.used == 0, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num()
        weight = there / (1 + (off / (2 * usual).clamp(min=1e-9)).square())
    return line
