"""Strips of an image along edges: by how much each of their lines is shifted against the edge's mean picture.

The picture T(t) of an edge is the mean of its strip over the lines. A line shows a + b T(t - s), which for a small
shift s is a + b T(t) - b s T'(t): least squares give b, its contrast, and b s. A line without contrast shows nothing.

Source: Lucas & Kanade 1981, in one dimension.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.stages.line_motion.edges.cells import Cells

_REACH_CELLS = 4  # of a strip to either side of its edge
_BESIDE = 2  # cells beside a strip, for slopes at its ends
_SPARE_CELLS = 8  # by which a strip can be moved
_AT_ONCE = 1024  # lines


@dataclass(frozen=True)
class Shifts:
    """Contrast b of the lines of edges over that of their mean pictures, and b s, in cells; of every image."""

    contrast: Float[Tensor, "views edges lines"]
    moved: Float[Tensor, "views edges lines"]


@dataclass(frozen=True)
class Strips:
    """Cells from ``first`` on around edges, of every image."""

    first: Int[Tensor, "views edges lines"]
    values: Float[Tensor, "views edges lines size"]

    @classmethod
    def read(cls, cells: Cells, place: Float[Tensor, "views edges lines"], lines: range) -> "Strips":
        """Those around places, in cells."""
        reach = _REACH_CELLS + _BESIDE + _SPARE_CELLS
        first = place.floor().long() - reach
        values = [cells.windows(view, first[view], 2 * reach + 2, lines) for view in range(len(place))]
        return cls(first, torch.stack(values))

    def of(self, edges: Tensor) -> "Strips":
        """Those of some edges."""
        return Strips(self.first[:, edges], self.values[:, edges])

    def shifts(self, place: Float[Tensor, "views edges lines"], there: Bool[Tensor, "edges lines"]) -> Shifts:
        """Shifts of lines from places; the mean pictures are those of the lines on which an edge is ``there``."""
        seen = self._at(place)
        known = _by_picture(_mean(seen, there))
        found = torch.linalg.pinv(known) @ seen[..., _BESIDE:-_BESIDE].mT
        return Shifts(found[..., 1, :], -found[..., 2, :])

    def alike(
        self, place: Float[Tensor, "views edges lines"], there: Bool[Tensor, "edges lines"]
    ) -> Float[Tensor, "2 edges"]:
        """Contrast of the mean picture of edges in the right image over that in the left one, and its shift, cells."""
        picture = _mean(self._at(place), there)
        seen = picture[1, :, _BESIDE:-_BESIDE, None]
        _, contrast, moved = (torch.linalg.pinv(_by_picture(picture[0])) @ seen)[..., 0].unbind(-1)
        return torch.stack([contrast, -moved / contrast])

    def _at(self, place: Float[Tensor, "views edges lines"]) -> Float[Tensor, "views edges lines wide"]:
        """Strips about places and what is beside them; some lines at a time, as that takes sixteen times the memory."""
        parts = zip(*(each.split(_AT_ONCE, dim=2) for each in (self.values, place - self.first)), strict=True)
        return torch.cat([_interpolated(values, middle) for values, middle in parts], dim=2)


def _interpolated(
    values: Float[Tensor, "views edges lines size"], middle: Float[Tensor, "views edges lines"]
) -> Float[Tensor, "views edges lines wide"]:
    """Strips about their middles, counted from their first cells, by cubic convolution (Keys 1981)."""
    t = torch.arange(-_REACH_CELLS - _BESIDE, _REACH_CELLS + _BESIDE + 1).to(middle)
    at = (middle[..., None] + t).clamp(1, values.shape[-1] - 2)
    base = at.floor().clamp(max=values.shape[-1] - 3).long()
    f = at - base
    weights = (
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    )
    values = values.to(middle)
    taps = [weight * values.gather(-1, base + k - 1) for k, weight in enumerate(weights)]
    return torch.stack(taps).sum(0)


def _mean(seen: Float[Tensor, "views edges lines wide"], there: Tensor) -> Float[Tensor, "views edges wide"]:
    """Mean over the lines of every edge on which it is there."""
    share = there.to(seen) / there.sum(1, keepdim=True).clamp(min=1)
    return (share[..., None] * seen).sum(2)


def _by_picture(picture: Float[Tensor, "*batch wide"]) -> Float[Tensor, "*batch strip 3"]:
    """Derivatives of a line by its brightness, its contrast and its shift.

    Slopes are those of quartics through five cells: a parabola through three takes a sharp edge for a fifth less steep.
    """
    middle = picture[..., _BESIDE:-_BESIDE]
    near, far = picture[..., 3:-1] - picture[..., 1:-3], picture[..., 4:] - picture[..., :-4]
    return torch.stack([torch.ones_like(middle), middle - middle.mean(-1, keepdim=True), (8 * near - far) / 12], -1)
