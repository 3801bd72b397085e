"""A pair of line cameras as they are built and mounted, before any rectification."""

from dataclasses import dataclass, field

from lsvision.schema import Checked, NonNegative, Positive, PositiveInt

_OF_CAMERA = ("focal_length_mm", "principal_point_px", "turn_deg", "distortion.0", "distortion.1")
# What a rig consists of, by the names and in the units of its file.
RIG_QUANTITIES = (
    *(f"left.{name}" for name in _OF_CAMERA),
    *(f"right.{name}" for name in _OF_CAMERA),
    "baseline_mm",
    *(f"right.view_plane.{name}" for name in ("offset_mm", "slope_x", "slope_z")),
)


@dataclass(frozen=True)
class RawCamera(Checked):
    """A line camera: its lens, and the turn of its optical axis about Y, rad, positive towards larger X.

    ``distortion`` is (k1, k2) of t' = t (1 + k1 t² + k2 t⁴) with t = (u - c) / f.
    """

    focal_length_mm: Positive
    principal_px: float
    turn_rad: float = 0.0
    distortion: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class ViewPlane(Checked):
    """The plane Y = ``offset_mm`` + ``slope_x`` (x - B/2) + ``slope_z`` (z - z0) that a camera looks at.

    z0 is the depth where the middles of both sensors look at the same point.
    """

    offset_mm: float = 0.0
    slope_x: float = 0.0
    slope_z: float = 0.0


@dataclass(frozen=True)
class RawRig(Checked):
    """Two raw line cameras, ``baseline_mm`` apart along X.

    The left one looks at the plane Y = 0, which is the scan plane; the right one at ``view_plane``.
    ``color_spacing_lines`` is as in ``Rig``. ``sigma`` are the standard deviations of its quantities, by their names in
    the file, in the file's units; what is not named counts as exact. ``covariance`` is that of all ``RIG_QUANTITIES``,
    as a calibration left it, and replaces ``sigma`` where it is there.
    """

    width_px: PositiveInt
    pixel_pitch_um: Positive
    baseline_mm: Positive
    left: RawCamera
    right: RawCamera
    view_plane: ViewPlane = field(default_factory=ViewPlane)
    color_spacing_lines: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: tuple[tuple[str, NonNegative], ...] = ()
    covariance: tuple[tuple[float, ...], ...] | None = None
