"""Crossings of edges with the lines of both images, in pairs that show one point of the object."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.geometry import Rectification, line_at, travel_at
from lsvision.image.board.edges import Crossings, EdgeSegments, common_lines, find_crossings
from lsvision.types import StereoPair, Travel

_ROUNDS = 3  # each brings the line of the right crossing nearer by the slope of the planes: a hundred times


@dataclass(frozen=True)
class CrossedPair:
    """Columns at which both images show crossings, by segment and line of the left image.

    ``later_mm`` is the travel from the left camera's line to the right one's; None where they are the same.
    """

    segment: Int[Tensor, " crossings"]
    line: Int[Tensor, " crossings"]
    left_px: Float[Tensor, " crossings"]
    right_px: Float[Tensor, " crossings"]
    sigma_px: Float[Tensor, " crossings"]
    valid: Bool[Tensor, " crossings"]
    later_mm: Float[Tensor, " crossings"] | None = None


def same_lines(images: StereoPair, left: EdgeSegments, right: EdgeSegments) -> CrossedPair:
    """Crossings with the same lines, as of cameras that look at one plane."""
    segment, line = common_lines(left, right)
    of_left = find_crossings(images.left, left, segment, line)
    of_right = find_crossings(images.right, right, segment, line)
    valid, sigma = _alike(of_left, of_right)
    return CrossedPair(segment, line, of_left.column, of_right.column, sigma, valid)


def same_points(
    images: StereoPair, left: EdgeSegments, right: EdgeSegments, rectification: Rectification, travel: Travel
) -> CrossedPair:
    """Crossings of the left image's lines, and of the lines of the right image that show the same points.

    Those lie between two lines, as whose crossings they are interpolated.
    """
    segment, line = common_lines(left)
    of_left = find_crossings(images.left, left, segment, line)
    numbers = common_lines(right)
    of_right = find_crossings(images.right, right, *numbers)
    at, column = line.double(), right.column_at(segment, line)
    for _ in range(_ROUNDS):
        later = rectification.raw.meet(of_left.column, column, rectification.n).later_mm
        at = line_at(travel, travel_at(travel, line.double()) + later)
        column = right.column_at(segment, at)
    between = _interpolated(of_right, numbers, segment, at)
    valid, sigma = _alike(of_left, between)
    later = rectification.raw.meet(of_left.column, between.column, rectification.n).later_mm
    return CrossedPair(segment, line, of_left.column, between.column, sigma, valid, later)


def _alike(left: Crossings, right: Crossings) -> tuple[Bool[Tensor, " crossings"], Float[Tensor, " crossings"]]:
    """Which crossings both images show with the same side bright, and how well a column is located."""
    return left.valid & right.valid & (left.step * right.step > 0), ((left.variance + right.variance) / 2).sqrt()


def _interpolated(
    found: Crossings, numbers: tuple[Tensor, Tensor], segment: Int[Tensor, " wanted"], line: Float[Tensor, " wanted"]
) -> Crossings:
    """Crossings of segments with (fractional) lines, between those that were found on two neighbouring ones.

    Args:
        numbers: segments and lines of what was found, in order.
    """
    base = line.nan_to_num().floor()
    share = line - base
    size = int(max(numbers[1].max(), base.max())) + 2 if len(numbers[1]) else 1
    keys = numbers[0] * size + numbers[1]
    wanted = segment * size + base.long()
    places = [torch.searchsorted(keys, key).clamp(max=max(len(keys) - 1, 0)) for key in (wanted, wanted + 1)]
    there = [(keys[place] == key) & found.valid[place] for place, key in zip(places, (wanted, wanted + 1), strict=True)]
    first, second = places
    return Crossings(
        torch.lerp(found.column[first], found.column[second], share),
        torch.lerp(found.variance[first], found.variance[second], share),
        there[0] & there[1] & torch.isfinite(line),
        torch.lerp(found.step[first], found.step[second], share),
    )
