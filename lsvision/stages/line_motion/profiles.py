"""Samples of lines in the product frame, and the object's reference profile that they are compared with."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.geometry import ProductFrame, depth_sigma, slope_at, zero_disparity_mm
from lsvision.types import Depth

_DISPARITY_SIGMA_PX = 0.09  # of a depth that comes without its own; the noise's true scale is estimated
_STEEPEST = 2.5  # slope beyond which a place is left out: a matching window sees more than one height there
_SLOPE_REACH_MM = 0.4  # to either side of a place, over which the slope of a profile is taken


@dataclass(frozen=True)
class LineSamples:
    """What some lines measured on some columns, float64: depth z and its standard deviation, mm, NaN where nothing.

    ``slope`` is that of the columns' rays, and ``plane_slope`` the Y of where they look per mm of depth: the lines of
    another colour look along a plane of their own.
    """

    z: Float[Tensor, "lines columns"]
    sigma: Float[Tensor, "lines columns"]
    slope: Float[Tensor, " columns"]
    columns: Int[Tensor, " columns"]
    plane_slope: float = 0.0

    @classmethod
    def of(
        cls, depth: Depth, frame: ProductFrame, height_range_mm: tuple[float, float], columns: slice
    ) -> "LineSamples":
        """Some columns of some lines."""
        z0, (low, high) = zero_disparity_mm(frame.rig), height_range_mm
        z = depth.z[:, columns].double()
        z = z.masked_fill(~((z >= z0 - high) & (z <= z0 - low)), torch.nan)
        given = depth.sigma
        sigma = depth_sigma(frame.rig, z, _DISPARITY_SIGMA_PX) if given is None else given[:, columns].double()
        numbers = torch.arange(depth.z.shape[1])[columns]
        return cls(z, sigma, slope_at(frame.rig, numbers.double()), numbers)

    def on(self, columns: slice) -> "LineSamples":
        """Those of some columns."""
        parts = self.z[:, columns], self.sigma[:, columns], self.slope[columns], self.columns[columns]
        return LineSamples(*parts, self.plane_slope)

    def among(self, seen: Bool[Tensor, "lines columns"]) -> "LineSamples":
        """Those ``seen``, on the columns between the first and the last that any line has."""
        some = seen.any(0).nonzero()[:, 0]
        columns = slice(int(some[0]), int(some[-1]) + 1) if len(some) else slice(0, 1)
        part = self.on(columns)
        return replace(part, z=part.z.masked_fill(~seen[:, columns], torch.nan))

    def split(self, lines: int) -> "list[LineSamples]":
        """Those of some lines after the other."""
        parts = zip(self.z.split(lines), self.sigma.split(lines), strict=True)
        return [LineSamples(z, sigma, self.slope, self.columns, self.plane_slope) for z, sigma in parts]


@dataclass(frozen=True)
class Reference:
    """Height of the object by place across the motion: node i lies at ``origin_mm + i step_mm``; NaN beside it."""

    origin_mm: float
    step_mm: float
    height: Float[Tensor, " nodes"]
    slope: Float[Tensor, " nodes"]

    def at(self, q_x: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Height and its slope at places, linear between nodes; NaN beyond the object."""
        place = (q_x - self.origin_mm) / self.step_mm
        base = place.nan_to_num().floor().clamp(0, len(self.height) - 2).long()
        part = place - base
        part = part.masked_fill((part < 0) | (part > 1), torch.nan)
        height, slope = (torch.lerp(values[base], values[base + 1], part) for values in (self.height, self.slope))
        return height, slope


def reference_profile(
    q_x: Float[Tensor, "lines columns"], height: Float[Tensor, "lines columns"], step_mm: float, depth_mm: float
) -> Reference | None:
    """Median height by place of aligned lines, down to ``depth_mm`` under the highest; None where nothing was measured.

    A place counts that half of the lines show.
    """
    measured = height.isfinite()
    if not bool(measured.any()):
        return None
    place, level = q_x[measured], height[measured]
    origin = float(place.min())
    position = (place - origin) / step_mm
    node = position.round().long()
    count = torch.bincount(node)
    common = count >= len(q_x) / 2
    if not bool(common.any()):
        return None
    reach = _reach(step_mm)
    first = _median_by_node(node, level).masked_fill(~common, torch.nan)
    # Samples of a line at rest lie beside the nodes, always at the same places: the slope takes them there.
    beside = torch.zeros_like(first).index_add_(0, node, position - node) / count.clamp(min=1)
    slope = _slopes(first, torch.arange(len(first)) + beside, reach, step_mm)
    moved = level - (slope.nan_to_num()[node] * (position - node)) * step_mm
    profile = _median_by_node(node, moved).masked_fill(~common, torch.nan)
    crown = float(profile.nan_to_num(-torch.inf).max())
    return reference_of(origin, step_mm, profile.masked_fill(~(profile >= crown - depth_mm), torch.nan))


def reference_of(origin_mm: float, step_mm: float, height: Float[Tensor, " nodes"]) -> Reference | None:
    """A reference of these heights; None where nothing shows a slope."""
    reach = _reach(step_mm)
    slope = _slopes(height, torch.arange(len(height)), reach, step_mm)
    slope = slope.masked_fill(slope.abs() > _STEEPEST, torch.nan)
    if not bool(slope.isfinite().any()):
        return None
    # A slope of noise would show sideways motion where a flat profile shows none.
    return Reference(origin_mm, step_mm, height, slope.masked_fill(slope.abs() < _sloping(slope, reach), 0.0))


def _reach(step_mm: float) -> int:
    """Nodes to either side that a slope takes."""
    return max(1, round(_SLOPE_REACH_MM / step_mm))


def _sloping(slope: Tensor, reach: int) -> float:
    """Least slope that stands out from noise: three standard deviations of the unevenness of slopes far apart."""
    apart = 2 * reach + 1  # no height is in two of them
    uneven = slope[apart:-apart] - (slope[: -2 * apart] + slope[2 * apart :]) / 2
    sigma = NORMAL_OVER_MAD * uneven.abs().nanmedian() / math.sqrt(1.5) if len(uneven) else uneven.new_zeros(())
    return float(3 * sigma.nan_to_num())


def _slopes(height: Tensor, position: Tensor, reach: int, step_mm: float) -> Tensor:
    """Slopes of heights at positions, in steps, from those ``reach`` nodes to either side; NaN at the ends."""
    slope = torch.full_like(height, torch.nan)
    run = (position[2 * reach :] - position[: -2 * reach]) * step_mm
    slope[reach : len(height) - reach] = (height[2 * reach :] - height[: -2 * reach]) / run
    return slope


def columns_of(reference: Reference, q_x: Float[Tensor, "lines columns"], most: int) -> slice | None:
    """At most so many columns, evenly spaced, that show the object on some of the lines with samples at ``q_x``.

    None where the object is narrower than a slope takes.
    """
    there = reference.slope.isfinite().nonzero()[[0, -1], 0]
    low, high = (reference.origin_mm + reference.step_mm * there.double()).tolist()
    shown = ((q_x > low) & (q_x < high)).any(0).nonzero()[:, 0]
    if not len(shown):
        return None
    first, end = int(shown[0]), int(shown[-1]) + 1
    return slice(first, end, -(-(end - first) // most))


def _median_by_node(node: Int[Tensor, " values"], values: Float[Tensor, " values"]) -> Float[Tensor, " nodes"]:
    """Median of the values of every node from 0 on, to 1e-12 of their range for each node."""
    least, span = values.min(), 2 * (values.max() - values.min()) + 1
    keys = np.sort((node + (values - least) / span).numpy())  # by node, then by value; in a tenth of argsort's time
    count = torch.bincount(node)
    middle = (count.cumsum(0) - count + count // 2).clamp(max=len(values) - 1)
    return (torch.from_numpy(keys)[middle] - torch.arange(len(count))) * span + least
