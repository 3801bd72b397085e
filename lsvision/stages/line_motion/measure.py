"""Scan + depth + motion -> motion from line to line, from the profile of an object that is the same all along.

1. The reference: lines spread over the scan are aligned to each other and give the object's own profile.
2. Every line is registered to it, in blocks at fixed places of the scan.
3. Its displacements are smoothed, and those components kept that are there (``estimate``).
4. Where the profile does not show sideways motion, straight edges of a flat object do (``flat``).

A profile that changes along the object, as a bent, twisted or corrugated rail's, is the same signal as a motion. The
lines of the colours, or a stated prior, separate them (``shape``).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import (
    ProductFrame,
    color_shift,
    middle_point,
    object_pitch_mm,
    project,
    shaken,
    slope_at,
)
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.stages.line_motion.color_differences import measure_color_differences
from lsvision.stages.line_motion.color_pair import ColorPair, ObjectPlace, color_pair
from lsvision.stages.line_motion.color_travel import ColorTravel, measure_color_travel, with_travel
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.crown import CrownedLines
from lsvision.stages.line_motion.errors import LineErrors
from lsvision.stages.line_motion.estimate import not_measured
from lsvision.stages.line_motion.estimated import Estimated
from lsvision.stages.line_motion.flat import measure_flat
from lsvision.stages.line_motion.profiles import Reference, columns_of, reference_profile
from lsvision.stages.line_motion.register import placed, register
from lsvision.stages.line_motion.registration import register_scan
from lsvision.stages.line_motion.section import fit_section
from lsvision.stages.line_motion.shape import ShapeData, without_shape
from lsvision.types import Depth, DepthSource, LineMotion, Motion, Scan, Section, SectionFit

_WINDOWS = 8  # of neighbouring lines, that the reference of a long scan comes from
_APART = 4  # lines of a window; neighbours err alike
_ROUNDS = 2  # of making the reference of lines and aligning them to it, before the last reference


@dataclass(frozen=True)
class LineMeasurement:
    """What lines show: the motion from line to line, and the travel by the colours; None where all look at one line."""

    motion: LineMotion
    travel: ColorTravel | None = None


def measure_line_motion(
    scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig, section: Section | None = None
) -> LineMeasurement:
    """Measure how every line of a scan is displaced and rolled, from its profile and edges, and how far it advances.

    Args:
        depth: of the left image. motion: n of the calibration. section: that ``config.reference`` names.

    Returns:
        What is not there or cannot be seen is zero, and ``findings`` of the motion says so.

    Raises:
        ValueError: ``config.reference`` names a section, and none is given.
    """
    if (config.reference == "scan") != (section is None):
        given = "none" if section is None else section.name
        raise ValueError(f"section: expected the one of config.reference, {config.reference!r}, got {given}")
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    shown = _shown(frame, depth, config)
    if shown is not None and section is not None:
        shown = shown.on_section(section, config)
    if shown is None:
        return LineMeasurement(not_measured(depth.lines, "no profile that half of the lines show was measured"))
    registered = register_scan(frame, depth, shown.reference, shown.columns, config)
    seen = Estimated.of(registered, shown.samples, frame, config)
    if config.straight_edges:
        seen = measure_flat(scan, depth, (shown.reference, shown.columns), seen, frame, config)
    found, lines, valid = seen.motion, seen.registered.lines, seen.valid
    pair = _colors(scan, frame, shown.place(lines.values[:, 1] * valid, found, frame))
    if not found.is_still:
        columns = shown.reference, shown.columns
        differences = None if pair is None else measure_color_differences(pair, depth, lines, columns, config)
        found = without_shape(found, ShapeData(lines, valid, seen.along, seen.registered.errors, differences), config)
    travel = None if pair is None else measure_color_travel(pair, shown.columns)
    found = found if travel is None else with_travel(found, travel, seen.along)
    placed_section = _placed_section(shown, lines.values[valid], seen.registered.errors, frame)
    return LineMeasurement(replace(found, section=placed_section), travel)


def measure_travel(scan: Scan, depth: DepthSource, motion: Motion, config: LineMotionConfig) -> ColorTravel | None:
    """How far the object advances from line to line, from the lines of the colours; None where all look at one line.

    Lines are not registered for it: the object is taken at the mean depth of its profile, and at rest. A vibration of
    0.3 mm rms makes the rate up to 5e-4 too large; ``measure_line_motion`` follows it.

    Args:
        depth: of the left image. motion: n of the calibration.
    """
    if color_shift(scan) is None:
        return None
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    shown = _shown(frame, depth, config)
    if shown is None:
        return None
    at_rest = not_measured(depth.lines, "")
    pair = _colors(scan, frame, shown.place(at_rest.dz_mm, at_rest, frame))
    return None if pair is None else measure_color_travel(pair, shown.columns)


@dataclass(frozen=True)
class _Shown:
    """The reference profile, the columns that show it, and how many samples of a line usually take part.

    ``z`` is the depth of every column from the first to the last.
    """

    reference: Reference
    columns: slice
    samples: int
    z: Float[Tensor, " columns"]
    section: SectionFit | None = None

    def place(self, deeper_mm: Float[Tensor, " lines"], motion: LineMotion, frame: ProductFrame) -> ObjectPlace:
        """Of the object whose lines lie so much deeper, and are displaced by a motion."""
        middle = float(self.z.nanmean())
        column = (self.columns.start + self.columns.stop - 1) / 2
        still = motion.values.new_tensor([slope_at(frame.rig, column) * middle, middle]).expand(motion.lines, 2)
        seen, _ = project(frame.rig, *shaken(still, motion.values, middle_point(frame.rig)).unbind(-1))
        return ObjectPlace(middle + deeper_mm, (self.z - middle).nan_to_num(), seen - column, self.columns.start)

    def on_section(self, section: Section, config: LineMotionConfig) -> "_Shown":
        """With a section in place of the profile, where it is one of it."""
        laid = fit_section(self.reference, section, config)
        return self if laid is None else replace(self, reference=laid.reference, section=laid.fit)


def _placed_section(
    shown: _Shown, values: Float[Tensor, "lines 3"], errors: LineErrors, frame: ProductFrame
) -> SectionFit | None:
    """The section where it lies in the product, which shows lines at their mean displacement, not where it was laid."""
    laid, beside = shown.section, float(frame.axes[0] @ middle_point(frame.rig))
    if laid is None or not len(values):
        return laid
    dx, dz, roll = values.mean(0).tolist()
    of_mean = errors.rms * ((1 + 2 * errors.memory) / len(values)).sqrt()
    sigma = torch.hypot(of_mean, of_mean.new_tensor([laid.x_sigma_mm, laid.height_sigma_mm, laid.roll_sigma_rad]))
    x_sigma, height_sigma, roll_sigma = sigma.tolist()
    return replace(
        laid,
        x_mm=laid.x_mm + dx - roll * laid.height_mm,
        height_mm=laid.height_mm - dz + roll * (laid.x_mm - beside),
        roll_rad=laid.roll_rad + roll,
        x_sigma_mm=x_sigma,
        height_sigma_mm=height_sigma,
        roll_sigma_rad=roll_sigma,
    )


def _shown(frame: ProductFrame, depth: DepthSource, config: LineMotionConfig) -> _Shown | None:
    """What lines from all over the scan have in common; None where they have nothing."""
    spread = _spread_lines(depth, config.reference_lines)
    crowned = CrownedLines.of(spread, frame, config)
    samples, values = crowned.samples, crowned.values
    for _ in range(_ROUNDS):
        reference, columns = _seen_along(placed(samples, values, frame), frame, config)
        if reference is None or columns is None:
            return None
        found = register(samples.on(columns), values, reference, frame, config)
        values = found.values - found.values.median(0).values
    reference, columns = _seen_along(placed(samples, values, frame), frame, config)
    if reference is None or columns is None:
        return None
    z = (samples.z[:, columns.start : columns.stop] - values[:, 1, None]).nanmedian(0).values
    first = int(samples.columns[0])
    columns = slice(first + columns.start, first + columns.stop, columns.step)
    return _Shown(reference, columns, int(found.samples.median()), z)


def _seen_along(
    place: tuple[Tensor, Tensor], frame: ProductFrame, config: LineMotionConfig
) -> tuple[Reference | None, slice | None]:
    """Reference of aligned lines, (q_x, height), and the columns that show it; None where there is none."""
    q_x, height = place
    reference = reference_profile(q_x, height, object_pitch_mm(frame.rig), config.profile_depth_mm)
    return reference, None if reference is None else columns_of(reference, q_x, config.samples)


def _colors(scan: Scan, frame: ProductFrame, place: ObjectPlace) -> ColorPair | None:
    """The colours that look furthest apart; None where all colours look at one line."""
    if color_shift(scan) is None:
        return None
    return color_pair(scan, frame, relation_of_scan(scan, DisparityConfig()), place)


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
