"""Head of the rail 60E1 as a chain of points, and the point that a ray meets first.

Source: EN 13674-1, profile 60E1: crown of radius 300, 80 and 13 mm, 72 mm wide 14.3 mm below the crown, sides 1:20.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

_STEP_MM = 0.2  # of the chain: a chord lies within half a micrometre of an arc of radius 13 mm
_HALF_WIDTH_300 = 10.228
_HALF_WIDTH_80 = 26.0265
_SIDE_MM = 21.2
_LOWER_RADIUS_MM = 3.0
_UNDERCUT = math.radians(30.0)  # turn of the chain round the lower edge; steeper than any ray


@dataclass(frozen=True)
class Chain:
    """Points of a convex outline from left to right, ``step_mm`` apart; float64.

    Attributes:
        x: mm, 0 on the crown.
        z: mm below the crown.
        angle: of the outward normal, from -z towards +x, rad.
        step_mm: distance of neighbouring points along the outline.
        crown: index of the point on the crown.
    """

    x: Tensor
    z: Tensor
    angle: Tensor
    step_mm: float
    crown: int


@lru_cache(maxsize=1)
def head_60e1() -> Chain:
    """The visible part of the head, symmetric about the crown, as a chain with equal steps along the outline.

    The outline has continuous tangents, so it follows from its normal's angle a alone: dx = cos a ds, dz = sin a ds.
    """
    first = math.asin(_HALF_WIDTH_300 / 300.0)
    second = math.asin(math.sin(first) + (_HALF_WIDTH_80 - _HALF_WIDTH_300) / 80.0)
    side = math.atan(20.0)
    pieces = torch.tensor(  # length, first and last angle of the normal
        [
            (300.0 * first, 0.0, first),
            (80.0 * (second - first), first, second),
            (13.0 * (side - second), second, side),
            (_SIDE_MM, side, side),
            (_LOWER_RADIUS_MM * _UNDERCUT, side, side + _UNDERCUT),
        ],
        dtype=torch.float64,
    )
    s = torch.arange(int(pieces[:, 0].sum() / _STEP_MM) + 1, dtype=torch.float64) * _STEP_MM
    right = _along(pieces, s)
    left = right[:, 1:].flip(-1) * right.new_tensor([[-1.0], [1.0], [-1.0]])
    x, z, angle = torch.cat([left, right], dim=-1)
    return Chain(x, z, angle, _STEP_MM, len(s) - 1)


@dataclass(frozen=True)
class Hit:
    """Where rays meet the chain: ``valid`` if they do, the point (x, z), the arc length s, the angle of the normal."""

    valid: Tensor
    x: Tensor
    z: Tensor
    s: Tensor
    angle: Tensor


def slopes_from(chain: Chain, eye_x: Tensor, eye_z: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes dx/dz ``(h, points)`` at which eyes ``(h,)`` above the chain see its points, and the visible horizon.

    Nothing hides the crown. From there outwards, a point is hidden exactly if an earlier point has a larger slope. The
    horizon is that running extreme; it does not decrease from left to right.
    """
    slopes = (chain.x - eye_x[:, None]) / (chain.z - eye_z[:, None])
    left = slopes[:, : chain.crown + 1].flip(-1).cummin(-1).values.flip(-1)
    right = slopes[:, chain.crown :].cummax(-1).values
    return slopes.float(), torch.cat([left, right[:, 1:]], dim=-1).float()


def first_hit(chain: Chain, slopes: Tensor, horizon: Tensor, eye_z: Tensor, ray: Tensor) -> Hit:
    """First point of the chain on rays of slope dx/dz ``(h, w)`` from eyes ``(h,)``.

    Args:
        slopes, horizon: of ``slopes_from``, float32 ``(h, points)``.
        eye_z: z of the eyes in the frame of the chain, mm, negative above the crown.
        ray: slopes of the rays, float32 ``(h, w)``.
    """
    valid = (ray > horizon[:, :1]) & (ray < horizon[:, -1:])
    after = torch.searchsorted(horizon, ray.contiguous()).clamp_(1, len(chain.x) - 1)
    before = after - 1
    z, angle, x = (values.float() for values in (chain.z, chain.angle, chain.x))
    z_before, z_after = z[before], z[after]
    eye = eye_z.float()[:, None]
    miss_before = (z_before - eye) * (slopes.gather(-1, before) - ray)
    miss_after = (z_after - eye) * (slopes.gather(-1, after) - ray)
    share = (miss_before / (miss_before - miss_after)).clamp_(0.0, 1.0)
    return Hit(
        valid,
        torch.lerp(x[before], x[after], share),
        torch.lerp(z_before, z_after, share),
        (before - chain.crown + share) * chain.step_mm,
        torch.lerp(angle[before], angle[after], share),
    )


def _along(pieces: Tensor, s: Tensor) -> Tensor:
    """x, z and angle ``(3, points)`` at arc lengths s of an outline of arcs and straights that starts at (0, 0)."""
    length, begin, end = pieces.T[..., None]
    within = (s - (length.cumsum(0) - length)).clamp(min=0.0).minimum(length)
    turned = (end - begin) / length * within
    chord = within * torch.sinc(turned / (2.0 * math.pi))
    heading = begin + turned / 2
    return torch.stack([(chord * torch.cos(heading)).sum(0), (chord * torch.sin(heading)).sum(0), turned.sum(0)])
