"""Depth + motion -> the angle between the axis of an object that is the same all along and its motion.

Lines all over the scan are registered to their own mean profile; a trend of δx or δz along the travel is the angle
between the object's axis and the motion. Roll is taken for zero: on a crown it looks like a sideways displacement.

An object that runs along its own axis has no trend whatever n is: its section stays where it is. One that is pushed
askew, as a board by a guide, has the trend of its axis against n. Sigma follows from the scatter about the trend:
waves longer than the scan are not in it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.geometry import ProductFrame, object_pitch_mm, travel_at
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.crown import CrownedLines
from lsvision.stages.line_motion.profiles import columns_of, reference_profile
from lsvision.stages.line_motion.register import placed, register
from lsvision.types import Depth, DepthSource, Motion, Scan

_PLACES, _LINES = 24, 8  # along the scan, and lines of each
_ROUNDS = 3  # of making the reference of lines and aligning them to it
_ROLL_SIGMA = 2e-5  # rad, of a roll that counts as none
_LEAST_SHARE = 0.3  # of the usual samples, that a line must have
_FEWEST = 6  # places, of which a trend is taken
_OUTLIER = 3.0  # robust standard deviations
_UNSEEN_MM = 1.0  # standard deviation of a line's displacement beyond which its profile does not show it


@dataclass(frozen=True)
class Direction:
    """By how much an object runs beside n, degrees, sideways and in depth, with sigma; NaN where that is not seen."""

    sideways_deg: float
    sideways_sigma_deg: float
    in_depth_deg: float
    in_depth_sigma_deg: float


NOT_SEEN = Direction(math.nan, math.nan, math.nan, math.nan)


def measure_direction(scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig) -> Direction:
    """The direction of an object against a calibration's n.

    Args:
        depth: of the left image. motion: n of the calibration.
    """
    lines = _places(depth.lines)
    read = [depth.read(part.start, part.stop).z for part in lines]
    number = torch.cat([torch.arange(part.start, part.stop) for part in lines]).double()
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    shifts = _displacements(Depth(torch.cat(read)), frame, config)
    if shifts is None:
        return NOT_SEEN
    along = travel_at(scan.travel, number) * float(torch.linalg.vector_norm(motion.n))
    sides = [_angle(along, shifts[:, axis], len(lines)) for axis in (0, 1)]
    return Direction(*sides[0], *sides[1])


def _places(lines: int) -> list[range]:
    """Short ranges of lines at even distances."""
    count = max(1, min(_PLACES, lines // _LINES))
    step = min(_LINES, lines)
    return [range(start, start + step) for start in (i * (lines - step) // max(count - 1, 1) for i in range(count))]


def _displacements(depth: Depth, frame: ProductFrame, config: LineMotionConfig) -> Float[Tensor, "lines 2"] | None:
    """δx and δz of lines against their mean profile, mm, NaN where a line shows none; None where no line does."""
    crowned = CrownedLines.of(depth, frame, config)
    samples, values = crowned.samples, crowned.values
    for _ in range(_ROUNDS):
        q_x, height = placed(samples, values, frame)
        reference = reference_profile(q_x, height, object_pitch_mm(frame.rig), config.profile_depth_mm)
        columns = None if reference is None else columns_of(reference, q_x, config.samples)
        if reference is None or columns is None:
            return None
        found = register(samples.on(columns), values, reference, frame, config)
        information = found.information
        unrolled = information + torch.diag(values.new_tensor([1e-2, 1e-2, _ROLL_SIGMA**-2]))
        values = torch.linalg.solve(unrolled, (information @ found.values[..., None]))[..., 0]
        values = values - values.median(0).values
    known = found.samples > _LEAST_SHARE * found.samples.median()
    sigma = torch.linalg.inv(unrolled).diagonal(dim1=-2, dim2=-1)[:, :2].sqrt()
    return values[:, :2].masked_fill(~known[:, None] | (sigma > _UNSEEN_MM), torch.nan)


def _angle(along: Tensor, shift: Tensor, places: int) -> tuple[float, float]:
    """Slope of a displacement along the travel and its standard deviation, degrees, by the medians of places."""
    x, y = (values.reshape(places, -1).nanmedian(1).values for values in (along, shift))
    for _ in range(2):  # once more without outliers
        seen = y.isfinite()
        if int(seen.sum()) < _FEWEST:
            return math.nan, math.nan
        x, y = x[seen], y[seen]
        design = torch.stack([x - x.mean(), torch.ones_like(x)], -1)
        slope, level = torch.linalg.lstsq(design, y[:, None]).solution[:, 0]
        off = y - (slope * design[:, 0] + level)
        usual = NORMAL_OVER_MAD * off.abs().median()
        y = y.masked_fill(off.abs() > _OUTLIER * usual, torch.nan) if usual > 0 else y
    sigma = (off.square().sum() / (len(x) - 2) / design[:, 0].square().sum()).sqrt()
    return math.degrees(math.atan(float(slope))), math.degrees(float(sigma))
