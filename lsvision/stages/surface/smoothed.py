"""Departures smoothed, and fitted at a place: what candidates are found and measured by."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

_REACH = 3.0  # standard deviations, where the Gaussian is cut off
_LEAST_SHARE = 0.35  # of the Gaussian's weight that was measured
_FIT_MM = (0.5, 0.75, 1.0, 1.5, 2.0)  # radii of the discs over which a paraboloid is fitted
_LEAST_FIT = 5.0  # cells: errors of the matching are alike over about as many
_LEAST_SMOOTHING = 2.0  # cells
_MOST_UNBLURRED = 0.5  # of a value, that is made good of what was blurred
_FILLED = 8  # rounds of filling what is missing of a disc
_WHOLE = 0.6  # share of a disc that must be measured


@dataclass(frozen=True)
class Smoothing:
    """A Gaussian of a standard deviation in cells, and the weights of a paraboloid's value in its middle."""

    sigma: float
    fits: tuple["Paraboloid", ...]

    @classmethod
    def of(cls, smoothing_mm: float, pitch_mm: float, blur: float) -> "Smoothing":
        """For cells of a size, of depths that are blurred by a Gaussian of ``blur`` cells."""
        sigma = max(_LEAST_SMOOTHING, smoothing_mm / pitch_mm)
        return cls(sigma, tuple(Paraboloid.of(radius, pitch_mm, blur) for radius in _FIT_MM))

    @property
    def radius(self) -> int:
        """Cells to either side that the Gaussian takes."""
        return max(1, math.ceil(_REACH * self.sigma))

    @property
    def halo(self) -> int:
        """Rows that any of them takes before and after those of interest."""
        return max(self.radius, *(fit.reach for fit in self.fits))

    @property
    def size(self) -> int:
        """Cells along a side of the square that ``averaged`` takes."""
        return 2 * self.radius + 1

    def averaged(self, plane: Float[Tensor, "rows cells"]) -> Float[Tensor, "rows cells"]:
        """Mean of what was measured in the square about every place; NaN where little was."""
        return _normalised(plane, lambda part: cv2.blur(part, (self.size, self.size), borderType=cv2.BORDER_CONSTANT))

    def smooth(self, plane: Float[Tensor, "rows cells"]) -> Float[Tensor, "rows cells"]:
        """Mean of what was measured by the Gaussian's weights; NaN where little was."""
        size, sigma = (self.size, self.size), self.sigma
        return _normalised(plane, lambda part: cv2.GaussianBlur(part, size, sigma, borderType=cv2.BORDER_CONSTANT))


def _normalised(
    plane: Float[Tensor, "rows cells"], blur: Callable[[NDArray[Any]], NDArray[Any]]
) -> Float[Tensor, "rows cells"]:
    """Blurred over what was measured alone."""
    there = plane.isfinite()
    total, weight = (torch.from_numpy(blur(part.numpy())) for part in (plane.nan_to_num(), there.float()))
    return (total / weight).masked_fill(weight < _LEAST_SHARE, torch.nan)


@dataclass(frozen=True)
class Paraboloid:
    """Least-squares paraboloids over a disc: ``weights`` are those of (1, y, x, y², xy, x²), zero outside the disc.

    A Gaussian of the standard deviation ``blur`` raises the bottom of a hollow by blur² / 2 times the sum of its second
    derivatives, which is taken off.

    Source: Savitzky and Golay (1964), in two dimensions.
    """

    radius_mm: float
    reach: int
    weights: Float[Tensor, "6 window"]
    blur: float = 0.0

    @classmethod
    def of(cls, radius_mm: float, pitch_mm: float, blur: float = 0.0) -> "Paraboloid":
        """For cells of a size."""
        radius = max(_LEAST_FIT, radius_mm / pitch_mm)
        reach = math.ceil(radius)
        steps = torch.arange(-reach, reach + 1).double()
        y, x = (of.flatten() for of in torch.meshgrid(steps, steps, indexing="ij"))
        inside = y.square() + x.square() <= radius**2
        design = torch.stack([torch.ones_like(x), y, x, y * y, x * y, x * x], -1) * inside[:, None]
        return cls(radius_mm, reach, torch.linalg.pinv(design), blur)

    def extreme(
        self, plane: Float[Tensor, "rows cells"], row: Int[Tensor, " places"], cell: Int[Tensor, " places"]
    ) -> Float[Tensor, " places"]:
        """Value of the paraboloid, unblurred, at its vertex, which must lie within half the disc, else in the middle.

        NaN where less than most of the disc was measured; what is missing of it takes the value of the rest's own fit.
        """
        rows, cells = plane.shape
        steps = torch.arange(-self.reach, self.reach + 1)
        y, x = row[:, None, None] + steps[:, None], cell[:, None, None] + steps
        inside = (y >= 0) & (y < rows) & (x >= 0) & (x < cells)
        window = plane[y.clamp(0, rows - 1), x.clamp(0, cells - 1)].double().masked_fill(~inside, torch.nan)
        window, disc = window.flatten(1), self.weights.any(0)
        there = window.isfinite() & disc
        values = window.where(there, window.masked_fill(~disc, torch.nan).nanmedian(1, keepdim=True).values)
        for _ in range(_FILLED):
            fit = values.nan_to_num() @ self.weights.T
            values = torch.where(there, window, fit @ self._design.T)
        fit = values.nan_to_num() @ self.weights.T
        lowest = self._vertex(fit)
        return lowest.masked_fill(there.sum(1) < _WHOLE * disc.sum(), torch.nan)

    @cached_property
    def _design(self) -> Float[Tensor, "window 6"]:
        steps = torch.arange(-self.reach, self.reach + 1).double()
        y, x = (of.flatten() for of in torch.meshgrid(steps, steps, indexing="ij"))
        return torch.stack([torch.ones_like(x), y, x, y * y, x * y, x * x], -1)

    def _vertex(self, fit: Float[Tensor, "places 6"]) -> Float[Tensor, " places"]:
        middle, by_y, by_x, yy, xy, xx = fit.unbind(-1)
        turn = 4 * yy * xx - xy.square()
        y, x = (xy * by_x - 2 * xx * by_y) / turn, (xy * by_y - 2 * yy * by_x) / turn
        near = (turn > 0) & (torch.hypot(y, x) <= self.reach / 2)
        lowest = torch.where(near, middle + (by_y * y + by_x * x) / 2, middle)
        most = _MOST_UNBLURRED * lowest.abs()
        return lowest - (self.blur**2 * (yy + xx)).clamp(-most, most)
