"""Motion from line to line: where a displaced and rolled object shows a point, and the inverse.

On line v the object's point p lies in the scan frame at

    P(v) = Ry(ρ) (p - y n - c) + c + (δx, 0, δz),      c = (B/2, 0, z0),

with y the travel of the line. Roll and displacement mix x and z of a line only: a point seen at (x, z) would have been
seen at (x', z') of the same line had the object been still, and p = (x', 0, z') + y n. Pitch and yaw of the object
within the time of a line are not modelled.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry.motion import travel_at
from lsvision.types import LineMotion, Travel


def shaken(
    still: Float[Tensor, "*#batch 2"], motion: Float[Tensor, "*#batch 4"], pivot: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 2"]:
    """Where a line shows, (x, z) mm, what it would have shown at (x', z') of a still object.

    Args:
        motion: (δx, δz, roll, δy) of the line, mm and rad; δy has no part in it. pivot: c.
    """
    (x, z), (dx, dz, roll, _) = (still - pivot[::2]).unbind(-1), motion.unbind(-1)
    cos, sin = torch.cos(roll), torch.sin(roll)
    return torch.stack([cos * x + sin * z + pivot[0] + dx, cos * z - sin * x + pivot[2] + dz], dim=-1)


def steadied(
    seen: Float[Tensor, "*#batch 2"], motion: Float[Tensor, "*#batch 4"], pivot: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 2"]:
    """Where a still object would have shown, (x', z') mm, what a line shows at (x, z): the inverse of ``shaken``."""
    dx, dz, roll, _ = motion.unbind(-1)
    x, z = seen[..., 0] - pivot[0] - dx, seen[..., 1] - pivot[2] - dz
    cos, sin = torch.cos(roll), torch.sin(roll)
    return torch.stack([cos * x - sin * z + pivot[0], sin * x + cos * z + pivot[2]], dim=-1)


def steadied_jacobian(
    still: Float[Tensor, "*#batch 2"], motion: Float[Tensor, "*#batch 4"], pivot: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 2 3"]:
    """Derivative of ``steadied`` (x', z'), given by its result, by (δx, δz, roll)."""
    roll = motion[..., 2]
    cos, sin = torch.cos(roll), torch.sin(roll)
    lever = still - pivot[::2]
    lever_x, lever_z = lever[..., 0].broadcast_to((cos + lever[..., 0]).shape), lever[..., 1]
    cos, sin, lever_z = (part.broadcast_to(lever_x.shape) for part in (cos, sin, lever_z))
    return torch.stack([torch.stack([-cos, sin, -lever_z], -1), torch.stack([-sin, -cos, lever_x], -1)], dim=-2)


@dataclass(frozen=True)
class LineAxes:
    """How lines lie in a frame: what is seen at (x, z) of a line lies at x across + z ahead + origin."""

    across: Float[Tensor, "*batch 3"]
    ahead: Float[Tensor, "*batch 3"]
    origin: Float[Tensor, "*batch 3"]


def line_axes(axes: Float[Tensor, "3 3"], motion: Float[Tensor, "*batch 4"], pivot: Float[Tensor, "3"]) -> LineAxes:
    """``steadied`` as an affine map into a frame with the rows ``axes``, for lines of some motion."""
    dx, dz, roll, _ = (part[..., None] for part in motion.unbind(-1))
    cos, sin = torch.cos(roll), torch.sin(roll)
    across, ahead = cos * axes[:, 0] + sin * axes[:, 2], cos * axes[:, 2] - sin * axes[:, 0]
    still = pivot[0] * axes[:, 0] + pivot[2] * axes[:, 2]
    return LineAxes(across, ahead, still - (pivot[0] + dx) * across - (pivot[2] + dz) * ahead)


def uneven_travel(travel: Travel, line_motion: LineMotion) -> Travel:
    """Travel of the lines with δy; the same object where no line has any.

    Raises:
        ValueError: the lines do not follow each other any more.
    """
    if not bool(line_motion.dy_mm.any()):
        return travel
    lines = torch.arange(line_motion.lines, dtype=torch.float64)
    sign = -1.0 if travel.transport == "reverse" else 1.0
    positions = sign * (travel_at(travel, lines) + line_motion.dy_mm)
    if not bool((positions.diff() > 0).all()):
        raise ValueError("line_motion.dy_mm must leave the lines in their order along the travel")
    return Travel(travel.line_pitch_mm, positions, travel.transport, travel.sigma_mm)


def without_trend(
    along_mm: Float[Tensor, " lines"], measured: Bool[Tensor, " lines"] | None = None
) -> Callable[[Float[Tensor, "*batch lines"]], Tensor]:
    """A function that removes the mean and the linear trend over the travel: the gauge of motion from line to line.

    Args:
        along_mm: travel of the lines, mm.
        measured: the lines, one at least, over which mean and trend are taken; None for all. The line that fits them
            is removed from every line.
    """
    share = torch.ones_like(along_mm) if measured is None else measured.to(along_mm)
    share = share / share.sum()
    centred = along_mm - (share * along_mm).sum()
    power = (share * centred.square()).sum().clamp(min=torch.finfo(centred.dtype).tiny)

    def remove(values: Tensor) -> Tensor:
        level = values - (share * values).sum(-1, keepdim=True)
        return level - (share * level * centred).sum(-1, keepdim=True) / power * centred

    return remove
