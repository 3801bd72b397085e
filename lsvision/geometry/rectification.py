"""A raw pair of line cameras and the ideal pair that stands for it: columns, depth, and where lines differ.

The ideal cameras have one focal length, no distortion and parallel axes, so that both look along
dx/dz = (u - c) / f. A raw column becomes an ideal one by its slope alone, whatever depth it sees. Lines do not: the
right camera looks at a plane of its own, and sees a point some travel later or earlier, which depends on where the
point lies (``RawPair.meet``).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.camera import Camera, depth_sigma, focal_length_px, slope_at
from lsvision.geometry.ideal_rig import ideal_rig, is_rectified
from lsvision.geometry.raw_pair import LineCamera, Met, RawPair
from lsvision.types import RawRig, Rig


@dataclass(frozen=True)
class RowShear:
    """By how much travel, mm, the columns of each matched image are read late, so that both show a point on one row.

    ``error_mm`` is how far a point of the depths that it was made for lies from that, at most.
    """

    left_mm: Float[Tensor, " width"]
    right_mm: Float[Tensor, " width"]
    error_mm: float


@dataclass(frozen=True)
class Rectification:
    """How the raw images of a pair lie over the ideal ones, for an object of motion n.

    Attributes:
        raw: the raw pair. raw_width: columns of its images. rig: the ideal one.
        n: motion, mm per nominal mm of travel, float64; the nominal one where it is not known yet.
    """

    raw: RawPair
    raw_width: int
    rig: Rig
    n: Float[Tensor, "3"]

    @classmethod
    def of(cls, raw: RawRig | None, n: Float[Tensor, "3"] | None = None) -> "Rectification | None":
        """That of a raw rig; None where there is none, or nothing to rectify."""
        if raw is None or is_rectified(raw):
            return None
        nominal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        return cls(RawPair.of(raw), raw.width_px, ideal_rig(raw), nominal if n is None else n)

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

    @cached_property
    def matched_right_columns(self) -> Float[Tensor, " width"]:
        """Columns of the raw right image that look along the ideal columns of those of the raw left one, float64.

        Read there, the right image has the columns of the left one, and the plane of zero disparity of the ideal pair:
        the left image need not be resampled along its lines to be matched.
        """
        return self.raw_column(self.ideal_left_columns, "right")

    @cached_property
    def ideal_left_columns(self) -> Float[Tensor, " raw_width"]:
        """The ideal columns of all columns of the raw left image, float64."""
        return self.ideal_column(torch.arange(self.raw_width, dtype=torch.float64))

    @cached_property
    def matched_rig(self) -> Rig:
        """A pair in front of whose cameras heights have the largest disparities that they have in matched images."""
        beside = torch.linspace(-_PARTNERS, 1 + _PARTNERS, _COLUMNS, dtype=torch.float64) * self.raw_width
        growth, rig = float(self.growth(beside, "left").min()), self.rig
        wide = (rig.principal_right_px - rig.principal_left_px) / growth
        return replace(
            rig,
            width_px=self.raw_width,
            focal_length_mm=rig.focal_length_mm / growth,
            principal_right_px=rig.principal_left_px + wide,
        )

    @cached_property
    def matched_columns(self) -> "MatchedColumns":
        """How the columns of the ideal left image turn disparities of matched images into depth."""
        return MatchedColumns.of(self)

    def row_shear(self, disparity_px: tuple[float, float]) -> RowShear | None:
        """Shear of the rows of matched images for points of a range of disparities; None where both planes are one.

        Along a row the right image is read ``later_mm`` after the left one, which depends on column and depth. Where
        columns of both images are read late by functions of their own, the difference between partners u and u - d
        depends on both: a common slope of the two functions makes a difference that is linear in d.
        """
        if not bool(self.raw.plane.any()):
            return None
        width = self.raw_width
        columns = torch.linspace(0, width - 1, _COLUMNS, dtype=torch.float64)[:, None]
        partner = columns - torch.linspace(*disparity_px, _DEPTHS, dtype=torch.float64)
        of_left, of_right = self.raw.left.slope(columns), self.raw.left.slope(partner) - self.convergence
        wanted = self.raw.meet_rays(of_left, of_right, self.n).later_mm.flatten()
        seen = ((partner >= 0) & (partner <= width - 1)).flatten()
        left, right = (_powers(at.expand_as(partner).flatten(), width)[seen] for at in (columns, partner))
        # Without a constant, the left image is not read late on the whole.
        both = torch.cat([right, -left[:, 1:]], dim=-1)
        solved = torch.linalg.lstsq(both, wanted[seen, None], driver="gelsd").solution[:, 0]
        error = (both @ solved - wanted[seen]).abs().max()
        powers = _powers(torch.arange(width, dtype=torch.float64), width)
        of_right, of_left = solved.split([_POWERS, _POWERS - 1])
        return RowShear(powers[:, 1:] @ of_left, powers @ of_right, float(error))

    @property
    def convergence(self) -> float:
        """By how much the slope of an ideal column of the left camera exceeds that of the right one."""
        return (self.rig.principal_right_px - self.rig.principal_left_px) / focal_length_px(self.rig)

    def _camera(self, camera: Camera) -> LineCamera:
        return self.raw.left if camera == "left" else self.raw.right


@dataclass(frozen=True)
class MatchedColumns:
    """Depth from disparities of matched images, for columns of the ideal left image.

    The inverse depth of a pair is nearly linear in the disparity. ``terms`` are Taylor's at no disparity, in powers of
    it: the fourth would be 4e-4 px.

    Attributes:
        places: columns of the raw left image, px.
        growth: ideal columns by raw ones, px/px.
    """

    rectification: Rectification
    places: Float[Tensor, " width"]
    growth: Float[Tensor, " width"]
    terms: Float[Tensor, "4 width"]

    @classmethod
    def of(cls, rectification: Rectification) -> "MatchedColumns":
        """All columns of the ideal left image."""
        columns = torch.arange(rectification.rig.width_px, dtype=torch.float64)
        places, of_left = rectification.raw_left_columns, slope_at(rectification.rig, columns)
        step = torch.tensor(_TAYLOR_STEP, dtype=torch.float64)

        def inverse_depth(disparity: Tensor) -> Tensor:
            of_right = rectification.raw.left.slope(places - disparity) - rectification.convergence
            return 1.0 / rectification.raw.meet_rays(of_left, of_right, rectification.n).z

        least, less, middle, more, most = (inverse_depth(at * step) for at in (-2, -1, 0, 1, 2))
        terms = [
            middle,
            (8 * (more - less) + least - most) / (12 * step),
            (less - 2 * middle + more) / (2 * step**2),
            (2 * less - 2 * more + most - least) / (12 * step**3),
        ]
        return cls(rectification, places, rectification.growth(places, "left"), torch.stack(terms))

    def part(self, columns: slice, like: Tensor) -> "MatchedColumns":
        """Some of the columns, with the dtype of another tensor; the places stay as they are."""
        growth, terms = (values[..., columns].to(like) for values in (self.growth, self.terms))
        return MatchedColumns(self.rectification, self.places[columns], growth, terms)

    def depth(self, disparity_px: Float[Tensor, "rows width"]) -> Float[Tensor, "rows width"]:
        """Depth z, mm; NaN where the rays do not meet in front of the cameras."""
        inverse = torch.addcmul(self.terms[2], self.terms[3], disparity_px)
        for term in (self.terms[1], self.terms[0]):
            inverse.mul_(disparity_px).add_(term)
        return inverse.masked_fill_(inverse <= 0, torch.nan).reciprocal_()

    def depth_sigma(
        self, z: Float[Tensor, "rows width"], disparity_sigma_px: Float[Tensor, "rows width"]
    ) -> Float[Tensor, "rows width"]:
        """Standard deviation of depths z, mm, from that of their disparities in matched images."""
        return depth_sigma(self.rectification.rig, z, disparity_sigma_px * self.growth)


_PARTNERS = 0.05  # of a line, by which partners may lie beside it
_TAYLOR_STEP = 50.0  # px, of the differences that give Taylor's terms
_POWERS = 5  # of the polynomials of a shear
_COLUMNS, _DEPTHS = 65, 9  # at which it is fitted


def _powers(column: Float[Tensor, " places"], width: int) -> Float[Tensor, "places powers"]:
    """Powers of columns, from -1 to 1 over a line."""
    return (2 * column / (width - 1) - 1)[:, None] ** torch.arange(_POWERS)
