"""The motion of the object under the cameras: what a scan measures, and where it lies on the object.

A point seen on line v, at (x, z) of the scan plane, lies at ``p = (x, 0, z) + y n`` with y = travel(v).
Source: Wang et al. 2024, Eq. 10, 11 and 15.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.types import Travel


def displace(measured: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points p = (x, 0, z) + y n of the moving object, mm, from measured (x, y = travel, z), mm (Eq. 10-11)."""
    x, y, z = measured.unbind(-1)
    return torch.stack([x, torch.zeros_like(y), z], dim=-1) + y[..., None] * n


def scan_position(points: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Measured (x, y = travel, z), mm, of points p of the object, mm: the inverse of ``displace``.

    n must have a part along Y: an object that never crosses the scan plane is never seen, and the result is not finite.
    """
    y = points[..., 1] / n[..., 1]
    return torch.stack([points[..., 0] - y * n[..., 0], y, points[..., 2] - y * n[..., 2]], dim=-1)


def travel_at(travel: Travel, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Nominal travel y, mm, at (fractional) lines; an encoder's log is interpolated, and extended at the line pitch.

    Raises:
        ValueError: the log does not increase.
    """
    sign = -1.0 if travel.transport == "reverse" else 1.0
    if travel.positions_mm is None:
        return sign * travel.line_pitch_mm * line
    log = _checked_log(travel.positions_mm).to(line)
    if log.numel() == 1:
        return sign * (log[0] + travel.line_pitch_mm * line)
    base = line.detach().nan_to_num().floor().clamp(0, log.numel() - 2).long()  # a NaN stays one by its weight
    inside = torch.lerp(log[base], log[base + 1], (line - base).clamp(0, 1))
    beyond = line.clamp(max=0) + (line - (log.numel() - 1)).clamp(min=0)
    return sign * (inside + travel.line_pitch_mm * beyond)


def travel_sigma(travel: Travel, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Standard deviation, mm, of the travel from the first line to (fractional) lines; zero but in a repaired log."""
    if travel.sigma_mm is None:
        return torch.zeros_like(line)
    sigma = travel.sigma_mm.to(line)
    base = line.detach().nan_to_num().floor().clamp(0, max(len(sigma) - 2, 0)).long()  # a NaN stays one by its weight
    at_line = torch.lerp(sigma[base], sigma[(base + 1).clamp(max=len(sigma) - 1)], (line - base).clamp(0, 1))
    return at_line.hypot(sigma[0])


def line_at(travel: Travel, travel_mm: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Fractional line that was scanned at a nominal travel y, mm: the inverse of ``travel_at``.

    Raises:
        ValueError: the log does not increase.
    """
    y = -travel_mm if travel.transport == "reverse" else travel_mm
    if travel.positions_mm is None:
        return y / travel.line_pitch_mm
    log = _checked_log(travel.positions_mm).to(y)
    if log.numel() == 1:
        return (y - log[0]) / travel.line_pitch_mm
    base = (torch.searchsorted(log, y.detach().contiguous(), right=True) - 1).clamp(0, log.numel() - 2)
    inside = ((y - log[base]) / (log[base + 1] - log[base])).clamp(0, 1)
    beyond = (y - log[0]).clamp(max=0) + (y - log[-1]).clamp(min=0)
    return base + inside + beyond / travel.line_pitch_mm


def _checked_log(positions_mm: Tensor) -> Tensor:
    if not bool((positions_mm.diff() > 0).all()):
        raise ValueError("travel.positions_mm must increase from line to line; repair the encoder log first")
    return positions_mm
