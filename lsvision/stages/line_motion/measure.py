"""Scan + depth + motion -> motion from line to line, from the profile of an object that is the same all along.

1. The reference: lines spread over the scan are aligned to each other and give the object's own profile.
2. Every line is registered to it, in blocks at fixed places of the scan.
3. Its displacements are smoothed, and those components kept that are there (``estimate``).

A profile that changes along the object, as a bent, twisted or corrugated rail's, is the same signal as a motion. The
lines of the colours, or a stated prior, tell them apart (``shape``).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from lsvision.geometry import ProductFrame, color_shift, depth_step_mm, object_pitch_mm, travel_at
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.stages.line_motion.color_differences import ColorDifferences, measure_color_differences
from lsvision.stages.line_motion.color_pair import color_pair
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.estimate import estimate, noisy_values, not_measured
from lsvision.stages.line_motion.profiles import LineSamples, Reference, columns_of, reference_profile
from lsvision.stages.line_motion.register import Registered, placed, register
from lsvision.stages.line_motion.shape import ShapeData, without_shape
from lsvision.types import Depth, DepthSource, LineMotion, Motion, Scan

_WINDOWS = 8  # of neighbouring lines, that the reference of a long scan comes from
_APART = 4  # lines of a window; neighbours err alike
_READ_LINES = 1024  # registered at once
_ROUNDS = 3  # of aligning lines and making the reference of them
_CROWN_SHARE = 0.95  # of the heights of a line: about its crown


def measure_line_motion(scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig) -> LineMotion:
    """Measure how every line of a scan is displaced and rolled, from its profile alone.

    Args:
        depth: of the left image. motion: n of the calibration.

    Returns:
        What is not there or cannot be seen is zero, and ``findings`` says so.
    """
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    shown = _shown(frame, depth, config)
    if shown is None:
        return not_measured(depth.lines, "no profile that half of the lines show was measured")
    lines = Registered.joined(list(_registered(frame, depth, shown, config)))
    along = travel_at(scan.travel, torch.arange(depth.lines).double())
    common_mm = depth_step_mm(scan.rig, config.common_error_px)
    motion_seen = estimate(lines, shown.samples, along, common_mm, config)
    if motion_seen.is_still:
        return motion_seen
    valid = noisy_values(lines, shown.samples, config).valid
    differences = _color_differences(scan, frame, depth, lines, shown, config)
    return without_shape(motion_seen, ShapeData(lines, valid, along, differences, common_mm), config)


@dataclass(frozen=True)
class _Shown:
    """The reference profile, the columns that show it, and how many samples of a line usually take part."""

    reference: Reference
    columns: slice
    samples: int


def _shown(frame: ProductFrame, depth: DepthSource, config: LineMotionConfig) -> _Shown | None:
    """What lines from all over the scan have in common; None where they have nothing."""
    spread = _spread_lines(depth, config.reference_lines)
    samples = LineSamples.of(spread, frame, config.height_range_mm, slice(None))
    values = samples.z.new_zeros(len(samples.z), 3)
    crown = placed(samples, values, frame)[1].nanquantile(_CROWN_SHARE, dim=1).nan_to_num()
    values[:, 1] = crown - crown.median()
    shown = None
    for _ in range(_ROUNDS):
        q_x, height = placed(samples, values, frame)
        reference = reference_profile(q_x, height, object_pitch_mm(frame.rig), config.profile_depth_mm)
        if reference is None:
            return None
        columns = columns_of(reference, q_x, config.samples)
        if columns is None:
            return None
        found = register(samples.on(columns), values, reference, frame, config)
        values = found.values - found.values.median(0).values
        shown = _Shown(reference, columns, int(found.samples.median()))
    return shown


def _registered(
    frame: ProductFrame, depth: DepthSource, shown: _Shown, config: LineMotionConfig
) -> Iterator[Registered]:
    """The lines of a scan, block by block."""
    for start in range(0, depth.lines, _READ_LINES):
        block = depth.read(start, min(start + _READ_LINES, depth.lines))
        samples = LineSamples.of(block, frame, config.height_range_mm, shown.columns)
        yield register(samples, samples.z.new_zeros(len(samples.z), 3), shown.reference, frame, config)


def _color_differences(
    scan: Scan, frame: ProductFrame, depth: DepthSource, lines: Registered, shown: _Shown, config: LineMotionConfig
) -> ColorDifferences | None:
    """How the object moved between the moments of the colours; None where all colours look at one line."""
    if color_shift(scan) is None:
        return None
    pair = color_pair(scan, frame, relation_of_scan(scan, DisparityConfig()))
    if pair is None:
        return None
    return measure_color_differences(pair, depth, lines, (shown.reference, shown.columns), config)


def _spread_lines(depth: DepthSource, count: int) -> Depth:
    """About ``count`` lines from all over a scan, at places that depend on its length alone."""
    window = math.ceil(count / _WINDOWS) * _APART
    if depth.lines <= _WINDOWS * window:
        whole = depth.read(0, depth.lines)
        return _every(whole, math.ceil(depth.lines / count))
    starts = [i * (depth.lines - window) // (_WINDOWS - 1) for i in range(_WINDOWS)]
    parts = [_every(depth.read(start, start + window), _APART) for start in starts]
    sigma = [part.sigma for part in parts if part.sigma is not None]
    return Depth(torch.cat([part.z for part in parts]), torch.cat(sigma) if sigma else None)


def _every(depth: Depth, stride: int) -> Depth:
    return Depth(depth.z[::stride], None if depth.sigma is None else depth.sigma[::stride])
