"""Which tracks are straight edges of one object: those on its surface that agree with each other.

Both images must show an edge where its object's depth says: what lies deeper or higher, as a rail of the machine over
the conveyor, is not the object's. Tracks whose places differ by more than a straight line are of different things; the
largest group that agrees is taken, if it is larger than what contradicts it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.edges.common import CommonMotion, EdgeFit, shape_length_mm
from lsvision.stages.line_motion.edges.edge_lines import EdgeLines, robust_straight

# Beyond the profile's ends, where an edge may be the object's side: that may be slanted, and depth fails beside it.
_BESIDE_MM = 15.0
_LEAST_ALIKE, _MOST_APART_CELLS = 0.5, 1.0  # contrast and shift of an edge's picture in the right image
_TRACK_CELLS = 0.75  # median distance of two tracks that agree

TOO_FEW = "fewer than two straight edges along the travel show it"


@dataclass(frozen=True)
class Agreed:
    """Edges that agree: what they have in common, and how many they are."""

    fit: EdgeFit
    count: int


def agreed(common: CommonMotion, config: LineMotionConfig) -> Agreed | str:
    """What agreeing edges among tracks show, or why there is nothing.

    Those that depart from the others once all are fitted must be fewer than those that are left.
    """
    on_it = _on_object(common)
    on_it &= common.there.sum(1) >= config.edge_share * common.lines.used.sum()
    within_mm = _TRACK_CELLS * common.cells.pitch_mm
    group = largest_group(common.place[on_it], common.there[on_it], common.lines, within_mm)
    edges, against, departs = on_it.nonzero()[group.members, 0], group.rivals, 0.0
    while len(edges) >= 2:
        fit = common.among(edges).fit()
        off = fit.shapes(common.lines, shape_length_mm(common.cells))
        if float(off.max()) > config.edges_within_mm:
            departs, against = float(off.max()), against + 1
            edges = edges[off < off.max()]
        elif against >= len(edges):
            return "its edges along the travel contradict each other"
        else:
            return Agreed(fit, len(edges))
    return f"two edges along the travel contradict each other by {departs:.2g} mm" if departs else TOO_FEW


def _on_object(common: CommonMotion) -> Bool[Tensor, " tracks"]:
    """Which tracks lie on the surface of the object, or at its sides."""
    flat, middle = common.flat, common.place[:, common.lines.used].median(1).values
    inside = (middle > flat.low_mm - _BESIDE_MM) & (middle < flat.high_mm + _BESIDE_MM)
    if common.cells.views == 1:
        return inside
    contrast, moved = common.alike()
    return inside & (contrast > _LEAST_ALIKE) & (moved.abs() < _MOST_APART_CELLS)


@dataclass(frozen=True)
class Group:
    """Tracks that agree, none or two at least, and how many of the others agree with each other and not with them."""

    members: Int[Tensor, " members"]
    rivals: int


def largest_group(
    place: Float[Tensor, "tracks lines"], there: Bool[Tensor, "tracks lines"], lines: EdgeLines, within_mm: float
) -> Group:
    """The tracks of the largest group of which one agrees with all others.

    Args:
        there: on which lines tracks follow an edge.
        within_mm: median distance of two tracks over the lines, but for a straight line, up to which they agree.
    """
    pairs, both = (place[:, None] - place).flatten(0, 1), (there[:, None] & there).flatten(0, 1)
    off = (pairs - robust_straight(pairs, lines, both.to(pairs)) @ lines.design.T).abs()
    middle = off.masked_fill(~both, torch.nan).nanmedian(1).values
    agree = middle.view(len(place), len(place)) <= within_mm
    if not len(place) or int(agree.sum(1).max()) < 2:
        return Group(torch.zeros(0).long(), 0)
    best = agree[int(agree.sum(1).argmax())]
    others = (agree & ~best)[~best].sum(1)
    rivals = int(others.max()) if len(others) else 0
    return Group(best.nonzero()[:, 0], rivals if rivals >= 2 else 0)
