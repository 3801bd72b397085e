"""A flat object under the cameras: where what lies on it shows in the images, on lines that are displaced.

Its profile is a straight line, height = h0 + h1 q_x, over a piece between steps: what lies lower beside it, as a
conveyor, is another piece.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.geometry import ProductFrame, line_axes, middle_point, project, slope_at
from lsvision.stages.line_motion.profiles import Reference

_LEAST_WIDTH_MM = 10.0  # of a piece of the profile
_STEP_MM = 1.0  # between neighbouring nodes of the profile, beyond which one piece ends
_FLAT_MM, _MOST = 0.5, 0.75  # from a straight line, within which most of a flat profile lies
_ALONE = 0.9  # of a profile, that is most of it
_CUT, _ROUNDS = 4.0, 5  # robust standard deviations of heights that count for the line


@dataclass(frozen=True)
class FlatObject:
    """A flat object in the product: its height at q_x = 0 and its slope, and from where to where it lies, mm.

    ``profile`` is its piece of the reference, which says that sideways motion does not show. ``is_alone`` states
    whether that is most of the reference.
    """

    frame: ProductFrame
    height_mm: float
    slope: float
    low_mm: float
    high_mm: float
    profile: Reference
    is_alone: bool

    @classmethod
    def of(cls, reference: Reference, frame: ProductFrame) -> "FlatObject | None":
        """The widest piece of a profile between steps, which lines were registered to; None where that is not flat."""
        q_x = reference.origin_mm + reference.step_mm * torch.arange(len(reference.height)).to(reference.height)
        piece = _widest_piece(reference)
        if piece is None:
            return None
        x, height = q_x[piece], reference.height[piece]
        design = torch.stack([torch.ones_like(x), x], 1)
        kept = torch.ones_like(x, dtype=torch.bool)
        for _ in range(_ROUNDS):
            line = torch.linalg.lstsq(design[kept], height[kept, None]).solution[:, 0]
            off = (height - design @ line).abs()
            kept = off <= _CUT * NORMAL_OVER_MAD * off.median() + 1e-9
        within = off <= _FLAT_MM
        if float(within.double().mean()) < _MOST:
            return None
        piece[piece.clone()] = within
        x = x[within]
        alone = reference.height.masked_fill(~piece, torch.nan)
        flat = torch.where(piece, 0.0, torch.nan).to(alone)
        profile = Reference(reference.origin_mm, reference.step_mm, alone, flat)
        is_alone = float(piece.sum()) >= _ALONE * float(reference.height.isfinite().sum())
        return cls(frame, float(line[0]), float(line[1]), float(x[0]), float(x[-1]), profile, is_alone)

    def across(
        self, left_px: Float[Tensor, "*batch lines"], motion: Float[Tensor, "lines 4"]
    ) -> Float[Tensor, "*batch lines"]:
        """q_x, mm, of what columns of the left image see of the object."""
        axes = line_axes(self.frame.axes, motion, middle_point(self.frame.rig))
        slope = slope_at(self.frame.rig, left_px)
        ray_x, ray_z = (slope * axes.across[:, i] + axes.ahead[:, i] for i in (0, 2))
        at_x, at_z = axes.origin[:, 0], axes.origin[:, 2]
        z = (self.frame.height_datum_mm - self.height_mm - at_z - self.slope * at_x) / (ray_z + self.slope * ray_x)
        return at_x + z * ray_x

    def columns(
        self, q_x: Float[Tensor, "*batch lines"], motion: Float[Tensor, "lines 4"]
    ) -> Float[Tensor, "2 *batch lines"]:
        """Columns of the left and of the right image, px, that see places of the object."""
        place = torch.stack([q_x, self.frame.height_datum_mm - self.height_mm - self.slope * q_x], -1)
        return torch.stack(project(self.frame.rig, *self.frame.shown_on_lines(place, motion).unbind(-1)))


def _widest_piece(reference: Reference) -> Bool[Tensor, " nodes"] | None:
    """Nodes of the widest piece of a profile between steps and gaps; None where no piece is wide enough."""
    height = reference.height
    there = height.isfinite() & reference.slope.isfinite()
    joined = there[1:] & there[:-1] & (height.diff().abs() < _STEP_MM)
    number = torch.cat([torch.zeros(1).long(), (~joined).long().cumsum(0)])
    widest = int(torch.bincount(number).argmax())
    piece = there & (number == widest)
    return piece if float(piece.sum()) * reference.step_mm >= _LEAST_WIDTH_MM else None
