"""A raw pair of line cameras and the ideal pair that stands for it: columns, depth, and where lines differ.

The ideal cameras have one focal length, no distortion and parallel axes, so that both look along
dx/dz = (u - c) / f. A raw column becomes an ideal one by its slope alone, whatever depth it sees. Lines do not: the
right camera looks at a plane of its own, and sees a point some travel later or earlier, which depends on where the
point lies (``RawPair.meet``).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.camera import Camera, focal_length_px, slope_at
from lsvision.geometry.raw_pair import LineCamera, Met, RawPair
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


def _with_columns(raw: RawRig, focal_mm: float, width: int, left_px: float, right_px: float) -> Rig:
    return Rig(width, raw.pixel_pitch_um, focal_mm, raw.baseline_mm, left_px, right_px, raw.color_spacing_lines)


@dataclass(frozen=True)
class RowShear:
    """By how much travel, mm, the columns of each ideal image are read late, so that both show a point on one row.

    ``error_mm`` is how far a point of the depths that it was made for lies from that, at most.
    """

    left_mm: Float[Tensor, " width"]
    right_mm: Float[Tensor, " width"]
    error_mm: float


@dataclass(frozen=True)
class Rectification:
    """How the raw images of a pair lie over the ideal ones, for an object of motion n.

    Attributes:
        raw: the raw pair. rig: the ideal one. n: motion, mm per nominal mm of travel, float64; the nominal one where it
            is not known yet.
    """

    raw: RawPair
    rig: Rig
    n: Float[Tensor, "3"]

    @classmethod
    def of(cls, raw: RawRig | None, n: Float[Tensor, "3"] | None = None) -> "Rectification | None":
        """That of a raw rig; None where there is none, or nothing to rectify."""
        if raw is None or is_rectified(raw):
            return None
        nominal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        return cls(RawPair.of(raw), ideal_rig(raw), nominal if n is None else n)

    def raw_column(self, column: Float[Tensor, "*batch"], camera: Camera = "left") -> Float[Tensor, "*batch"]:
        """Column of a raw image that looks along the ray of an ideal column, px."""
        return self._camera(camera).column(slope_at(self.rig, column, camera))

    def ideal_column(self, column: Float[Tensor, "*batch"], camera: Camera = "left") -> Float[Tensor, "*batch"]:
        """Ideal column along the ray of a column of a raw image, px."""
        principal = self.rig.principal_left_px if camera == "left" else self.rig.principal_right_px
        return principal + focal_length_px(self.rig) * self._camera(camera).slope(column)

    def growth(self, column: Float[Tensor, "*batch"], camera: Camera) -> Float[Tensor, "*batch"]:
        """By how many ideal columns the one along the ray of a raw column moves on with it by one, px/px."""
        return self.ideal_column(column + 0.5, camera) - self.ideal_column(column - 0.5, camera)

    @cached_property
    def raw_left_columns(self) -> Float[Tensor, " width"]:
        """The raw columns of all columns of the ideal left image, float64."""
        return self.raw_column(torch.arange(self.rig.width_px, dtype=torch.float64))

    def meet(self, left_px: Float[Tensor, "*#batch"], disparity_px: Float[Tensor, "*#batch"]) -> Met:
        """Where the rays of an ideal left column and of its partner meet on the object."""
        left = slope_at(self.rig, left_px)
        return self.raw.meet_rays(left, slope_at(self.rig, left_px - disparity_px, "right"), self.n)

    def depth(self, disparity_px: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        """Depth z, mm, of the disparities of ideal left columns; NaN where the rays do not meet in front."""
        columns = torch.arange(disparity_px.shape[1], dtype=torch.float64)
        of_left = slope_at(self.rig, columns).to(disparity_px)
        # The difference of both slopes is small beside them.
        offset = slope_at(self.rig, columns) - slope_at(self.rig, columns, "right")
        of_right = of_left - (disparity_px / focal_length_px(self.rig) + offset.to(disparity_px))
        z = self.raw.meet_rays(of_left, of_right, self.n.to(disparity_px)).z
        return torch.where(z > 0, z, torch.nan)

    def row_shear(self, disparity_px: tuple[float, float]) -> RowShear | None:
        """Shear of the rows of both images for points of a range of disparities; None where both planes are one.

        Along a row the right image is read ``later_mm`` after the left one, which depends on column and depth. Where
        columns of both images are read late by functions of their own, the difference between partners u and u - d
        depends on both: a common slope of the two functions makes a difference that is linear in d.
        """
        if not bool(self.raw.plane.any()):
            return None
        width = self.rig.width_px
        columns = torch.linspace(0, width - 1, _COLUMNS, dtype=torch.float64)[:, None]
        disparity = torch.linspace(*disparity_px, _DEPTHS, dtype=torch.float64)
        wanted = self.meet(columns, disparity).later_mm
        partner = (columns - disparity).flatten()
        seen = (partner >= 0) & (partner <= width - 1)
        of_left, of_right = (_powers(at, width)[seen] for at in (columns.expand_as(wanted).flatten(), partner))
        # Without a constant, the left image is not read late on the whole.
        both = torch.cat([of_right, -of_left[:, 1:]], dim=-1)
        solved = torch.linalg.lstsq(both, wanted.flatten()[seen, None], driver="gelsd").solution[:, 0]
        error = (both @ solved - wanted.flatten()[seen]).abs().max()
        powers = _powers(torch.arange(width, dtype=torch.float64), width)
        right, left = solved.split([_POWERS, _POWERS - 1])
        return RowShear(powers[:, 1:] @ left, powers @ right, float(error))

    def _camera(self, camera: Camera) -> LineCamera:
        return self.raw.left if camera == "left" else self.raw.right


_POWERS = 5  # of the polynomials of a shear
_COLUMNS, _DEPTHS = 65, 9  # at which it is fitted


def _powers(column: Float[Tensor, " places"], width: int) -> Float[Tensor, "places powers"]:
    """Powers of columns, from -1 to 1 over a line."""
    return (2 * column / (width - 1) - 1)[:, None] ** torch.arange(_POWERS)
