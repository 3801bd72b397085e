"""The ideal pair that a raw pair of line cameras stands for, and the same raw cameras with larger pixels."""

import math
from dataclasses import replace

import torch

from lsvision.geometry.raw_pair import RawPair
from lsvision.geometry.rig_errors import in_larger_pixels
from lsvision.types import RawRig, Rig, ViewPlane

_DIGITS = 6  # of px and mm: the ideal pair is a convention, and so is the same on every machine
_WIDEST = 4.0  # times the raw width; no lens stretches the rim of a line so much
_PLAIN = {"turn_rad": 0.0, "distortion": (0.0, 0.0)}


def is_rectified(raw: RawRig) -> bool:
    """Whether the raw cameras are an ideal pair already: no turn, no distortion, one focal length and one plane."""
    left, right = raw.left, raw.right
    plain = all(getattr(camera, name) == value for camera in (left, right) for name, value in _PLAIN.items())
    return plain and left.focal_length_mm == right.focal_length_mm and raw.view_plane == ViewPlane()


def ideal_rig(raw: RawRig) -> Rig:
    """The ideal pair of a raw one.

    Its focal length is the mean of both, its lines hold the whole field of the left camera, and its disparity is zero
    where the middles of both sensors look at the same point. A pair that is rectified already stays as it is.

    Raises:
        ValueError: the middles of the sensors look at no common point in front of the cameras, or the columns of a
            camera do not look along growing slopes that a straight line can hold.
    """
    focal_mm = (raw.left.focal_length_mm + raw.right.focal_length_mm) / 2
    if is_rectified(raw):
        return _with_columns(raw, focal_mm, raw.width_px, raw.left.principal_px, raw.right.principal_px)
    pair, focal_px = RawPair.of(raw), focal_mm / (raw.pixel_pitch_um * 1e-3)
    columns = torch.arange(raw.width_px, dtype=torch.float64)
    for name, camera in (("left", pair.left), ("right", pair.right)):
        slope = camera.slope(columns)
        if not (bool((slope.diff() > 0).all()) and float(slope[-1] - slope[0]) * focal_px <= _WIDEST * raw.width_px):
            raise ValueError(f"{name}: expected columns that look along growing slopes, up to less than 90 degrees")
    z0 = float(pair.z0_mm)
    if not (z0 > 0 and math.isfinite(z0)):
        raise ValueError("the middles of both sensors look at no common point in front of the cameras")
    first, last = (float(pair.left.slope(column)) for column in columns[[0, -1]])
    principal = round(-focal_px * first, _DIGITS)
    width = math.ceil(round(focal_px * (last - first), _DIGITS)) + 1
    return _with_columns(raw, focal_mm, width, principal, round(principal + focal_px * raw.baseline_mm / z0, _DIGITS))


def scaled_raw_rig(raw: RawRig, scale: float | int) -> RawRig:
    """The same raw cameras with ``scale`` times larger pixels over the same field, as ``scaled_rig``.

    Raises:
        ValueError: the scale is below 1.
    """
    if scale < 1:
        raise ValueError(f"scale must be at least 1, got {scale}")
    left, right = (
        replace(camera, principal_px=(camera.principal_px + 0.5) / scale - 0.5) for camera in (raw.left, raw.right)
    )
    red, green, blue = raw.color_spacing_lines
    scaled = replace(
        in_larger_pixels(raw, scale),
        width_px=math.ceil(raw.width_px / scale),
        pixel_pitch_um=raw.pixel_pitch_um * scale,
        left=left,
        right=right,
        color_spacing_lines=(red / scale, green / scale, blue / scale),
    )
    # The middle of the sensor may lie half a pixel elsewhere, and with it the z0 that the plane counts depth from.
    view, moved = raw.view_plane, float(RawPair.of(scaled).z0_mm - RawPair.of(raw).z0_mm)
    return replace(scaled, view_plane=replace(view, offset_mm=view.offset_mm + view.slope_z * moved))


def _with_columns(raw: RawRig, focal_mm: float, width: int, left_px: float, right_px: float) -> Rig:
    return Rig(width, raw.pixel_pitch_um, focal_mm, raw.baseline_mm, left_px, right_px, raw.color_spacing_lines)
