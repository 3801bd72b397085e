"""What is worn: each piece of a product against the nominal section that is laid on it.

The section lies where most of a piece's profile lies on it (``line_motion.section``), so that what is worn does not
move it. Distances are along its normal, below zero where metal is gone.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import reference_of
from lsvision.stages.line_motion.section import FittedSection, fit_section
from lsvision.stages.surface.profile import SurfaceProfile
from lsvision.types import ProductGrid, Section, SectionWear

_CROWN_MM = 10.0  # to either side of the middle
_CORNER_MM = (20.0, 34.0)  # from the middle
_WORST_MM = 2.0  # along a corner, over which its loss is the mean
_WIDTH_MM = 14.0  # under the crown, where the head's width is taken
_FEWEST = 5  # places


def worn(
    profile: SurfaceProfile, section: Section, grid: ProductGrid, scatter_mm: float, config: LineMotionConfig
) -> list[SectionWear]:
    """How every piece of a product departs from a section.

    Args:
        scatter_mm: standard deviation of sound surface, smoothed: what a mean over a few millimetres errs by at most.
    """
    found = []
    half = (grid.rows / len(profile.pieces)) / 2
    for piece, middle in zip(profile.pieces, profile.middle_rows.tolist(), strict=True):
        height = (profile.height + piece).masked_fill(~(profile.measured & piece.isfinite()), torch.nan)
        reference = reference_of(float(profile.q_x[0]), grid.pitch_mm, height)
        laid = None if reference is None else fit_section(reference, section, config)
        if laid is not None:
            first, last = (grid.q_y(0) + grid.pitch_mm * (middle + side) for side in (-half, half))
            found.append(_wear_of(laid, (first, last), scatter_mm))
    return found


def _wear_of(laid: FittedSection, span_mm: tuple[float, float], scatter_mm: float) -> SectionWear:
    fit, across = laid.fit, laid.across_mm
    near = laid.distance_mm
    level = math.hypot(scatter_mm, fit.height_sigma_mm)
    beside = math.hypot(level, max(fit.x_sigma_mm, _CORNER_MM[1] * fit.roll_sigma_rad))
    low, high = _CORNER_MM
    return SectionWear(
        first_mm=span_mm[0],
        last_mm=span_mm[1],
        is_section=fit.is_reference,
        share=fit.share,
        crown_mm=_mean(near, across.abs() <= _CROWN_MM),
        left_corner_mm=_worst(near, across, (-high, -low)),
        right_corner_mm=_worst(near, across, (low, high)),
        width_mm=_width(laid),
        crown_sigma_mm=level,
        corner_sigma_mm=beside,
        width_sigma_mm=math.sqrt(2) * scatter_mm,
    )


def _mean(values: Float[Tensor, " places"], among: Bool[Tensor, " places"]) -> float | None:
    return float(values[among].mean()) if int(among.sum()) >= _FEWEST else None


def _worst(
    values: Float[Tensor, " places"], across: Float[Tensor, " places"], span_mm: tuple[float, float]
) -> float | None:
    """The least mean over a few millimetres of a corner."""
    among = (across >= span_mm[0]) & (across <= span_mm[1])
    if int(among.sum()) < _FEWEST:
        return None
    long = max(_FEWEST, round(_WORST_MM / float(across[among].diff().abs().median())))
    return float(values[among].unfold(0, min(long, int(among.sum())), 1).mean(-1).min())


def _width(laid: FittedSection) -> float | None:
    """Between the two sides at one depth under the crown."""
    height, reference = laid.reference.height, laid.reference
    q_x = reference.origin_mm + reference.step_mm * torch.arange(len(height)).double()
    crown = int(height.nan_to_num(-torch.inf).argmax())
    level = float(height[crown]) - _WIDTH_MM
    right = _crossing(height[crown:], q_x[crown:], level)
    left = _crossing(height[: crown + 1].flip(0), q_x[: crown + 1].flip(0), level)
    return None if right is None or left is None else right - left


def _crossing(height: Float[Tensor, " places"], q_x: Float[Tensor, " places"], level: float) -> float | None:
    """Where an outline falls through a level for the first time."""
    below = (height < level).nonzero()[:, 0]
    if not len(below) or int(below[0]) == 0 or not bool(height[below[0] - 1].isfinite()):
        return None
    last, first = int(below[0]) - 1, int(below[0])
    share = (float(height[last]) - level) / (float(height[last]) - float(height[first]))
    return float(torch.lerp(q_x[last], q_x[first], share))
