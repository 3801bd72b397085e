"""The nominal section of an object, laid on the profile that its scan shows: where it lies, and what departs from it.

The section is moved by (x, height, roll) so that as much as can be of the profile lies on it: Tukey's M-estimate of the
distances along the normal, whose cut shrinks from millimetres to what most of the profile is off by. So worn parts do
not draw the section towards them. As reference it takes the place of the profile, without its noise; what departs from
it significantly, wear or another section, is added, as the lines show it: their registration must not suffer from it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import Reference, reference_of
from lsvision.types import Section, SectionFit

_STARTS_MM, _STARTS_DEG = (-6.0, -3.0, 0.0, 3.0, 6.0), (-6.0, -3.0, 0.0, 3.0, 6.0)
_CUTS_MM = (4.0, 1.0, 0.3, 0.1, 0.03)
_STEPS = 8  # with each cut
_CUT = 3.0  # times the median distance, at least
_LEAST_SHARE = 0.5  # of the profile that lies on a section which is the reference
_SMOOTHED_MM = 2.0  # over which departures are averaged
_SIGNIFICANT = 2.0  # standard deviations
_FEWEST = 8  # places of a profile
_FORGOTTEN = 0.1  # correlation of places below which the sum over the lags ends
_LOOSE = (0.01, 0.01, 10.0)  # roots of the information beforehand on x, height and roll, 1/mm and 1/rad


@dataclass(frozen=True)
class FittedSection:
    """Where a section lies, and the reference that the lines are compared with.

    ``distance_mm`` is that of the profile's places from the section along its normal, ``across_mm`` where on it.
    """

    fit: SectionFit
    reference: Reference
    across_mm: Float[Tensor, " places"]
    distance_mm: Float[Tensor, " places"]


def fit_section(profile: Reference, section: Section, config: LineMotionConfig) -> FittedSection | None:
    """Lay a section on a scan's own profile; None where that shows next to nothing.

    Args:
        profile: of aligned lines, which stays the reference where less than half of it lies on the section.
    """
    shown = (profile.height.isfinite() & profile.slope.isfinite()).nonzero()[:, 0]
    if len(shown) < _FEWEST:
        return None
    across = profile.origin_mm + profile.step_mm * shown.double()
    points, outline = torch.stack([across, profile.height[shown]], -1), section.outline
    place = _laid(points, outline)
    distance = _Distances.of(points, outline, place)
    sigma = distance.sigma()
    share = float((distance.value.abs() <= config.section_within_mm).double().mean())
    most = int(distance.value.abs().argmax())
    (x, height, roll), (x_sigma, height_sigma, roll_sigma) = place.tolist(), sigma.tolist()
    fit = SectionFit(
        name=section.name,
        x_mm=x,
        height_mm=height,
        roll_rad=roll,
        x_sigma_mm=x_sigma,
        height_sigma_mm=height_sigma,
        roll_sigma_rad=roll_sigma,
        share=share,
        within_mm=config.section_within_mm,
        departure_rms_mm=float(distance.value.square().mean().sqrt()),
        departure_most_mm=float(distance.value[most]),
        departure_across_mm=float(distance.across[most]),
        is_reference=share >= _LEAST_SHARE,
    )
    reference = _reference(profile, shown, distance) if fit.is_reference else None
    return FittedSection(fit, profile if reference is None else reference, distance.across, distance.value)


@dataclass(frozen=True)
class _Distances:
    """Signed distances of points from an outline along its normal, mm, above zero outside.

    ``across`` is where on the outline, ``by_place`` the derivative by (x, height, roll). ``cosine`` is that of the
    angle of the normal with the height of the product.
    """

    value: Float[Tensor, "*starts points"]
    across: Float[Tensor, "*starts points"]
    by_place: Float[Tensor, "*starts points 3"]
    cosine: Float[Tensor, "*starts points"]

    @classmethod
    def of(
        cls, points: Float[Tensor, "points 2"], outline: Float[Tensor, "vertices 2"], place: Float[Tensor, "*starts 3"]
    ) -> "_Distances":
        """Of points from an outline at a place."""
        x, height, roll = place[..., None, :].unbind(-1)
        cos, sin = torch.cos(roll), torch.sin(roll)
        right, up = points[:, 0] - x, points[:, 1] - height
        across, over = cos * right + sin * up, cos * up - sin * right
        level, slope = _at(outline, across)
        length = torch.rsqrt(1 + slope.square())
        normal_across, normal_up = -slope * length, length
        by_x, by_height = sin * normal_up - cos * normal_across, -(sin * normal_across + cos * normal_up)
        by_roll = normal_across * over - normal_up * across
        by_place = torch.stack([by_x, by_height, by_roll], -1)
        return cls((over - level) * length, across, by_place, -by_height)

    def weights(self, cut_mm: Float[Tensor, "*starts"]) -> Float[Tensor, "*starts points"]:
        """Tukey's."""
        return (1 - (self.value / cut_mm[..., None]).square()).clamp(min=0).square()

    def cut_mm(self, least_mm: float) -> Float[Tensor, "*starts"]:
        """What most of the points lie within."""
        return (_CUT * self.value.abs().median(-1).values).clamp(min=least_mm)

    def normal(self, weight: Float[Tensor, "*starts points"]) -> Float[Tensor, "*starts 3 3"]:
        """Normal equations' matrix."""
        loose = torch.diag(self.by_place.new_tensor(_LOOSE).square())
        return self.by_place.mT @ (weight[..., None] * self.by_place) + loose

    def sigma(self) -> Float[Tensor, "3"]:
        """Standard deviations of the place: neighbouring points depart alike, which leaves fewer independent ones."""
        weight = self.weights(self.cut_mm(_CUTS_MM[-1]))
        left = weight.sqrt() * self.value
        power = torch.fft.rfft(left, n=2 * len(left)).abs().square()
        correlation = torch.fft.irfft(power)[: len(left)]
        correlation = correlation / correlation[0].clamp(min=torch.finfo(left.dtype).tiny)
        alike = 2 * (correlation * (correlation > _FORGOTTEN).cumprod(0)).sum() - 1
        alike = alike.clamp(min=1.0)
        variance = alike * left.square().sum() / (weight.sum() - 3 * alike).clamp(min=1.0)
        return (variance * torch.linalg.inv(self.normal(weight)).diagonal()).sqrt()


def _laid(points: Float[Tensor, "points 2"], outline: Float[Tensor, "vertices 2"]) -> Float[Tensor, "3"]:
    """(x, height, roll) of an outline on points, the best of several starts about the middle of both."""
    middle = (points[0, 0] + points[-1, 0]) / 2 - (outline[0, 0] + outline[-1, 0]) / 2
    beside, roll = points.new_tensor(_STARTS_MM), points.new_tensor(_STARTS_DEG).deg2rad()
    place = torch.cartesian_prod(beside + middle, points.new_zeros(1), roll)
    rise = _Distances.of(points, outline, place)
    place[:, 1] = (rise.value / rise.cosine).median(-1).values
    for least in _CUTS_MM:
        for _ in range(_STEPS):
            distance = _Distances.of(points, outline, place)
            weight = distance.weights(distance.cut_mm(least))
            slope = (distance.by_place * (weight * distance.value)[..., None]).sum(-2)
            place = place - torch.linalg.solve(distance.normal(weight), slope)
    distance = _Distances.of(points, outline, place)
    cut = distance.cut_mm(_CUTS_MM[-1]).min()
    cost = 1 - (1 - (distance.value / cut).square()).clamp(min=0) ** 3
    return place[int(cost.mean(-1).argmin())]


def _at(outline: Float[Tensor, "vertices 2"], across: Float[Tensor, "*batch"]) -> tuple[Tensor, Tensor]:
    """Height and slope of an outline, linear between its vertices and on beyond the ends."""
    x, level = outline.T.contiguous()
    slope = torch.gradient(level, spacing=(x,))[0]
    after = torch.searchsorted(x, across.contiguous()).clamp(1, len(x) - 1)
    part = (across - x[after - 1]) / (x[after] - x[after - 1])
    return torch.lerp(level[after - 1], level[after], part), torch.lerp(
        slope[after - 1], slope[after], part.clamp(0, 1)
    )


def _reference(profile: Reference, shown: Tensor, distance: _Distances) -> Reference | None:
    """The section where the profile shows it, and what of the profile departs from it significantly."""
    reach = max(1, round(_SMOOTHED_MM / profile.step_mm / 2))
    off = torch.full_like(profile.height, torch.nan)
    off[shown] = distance.value
    around = pad(off, (reach, reach), value=torch.nan).unfold(0, 2 * reach + 1, 1)
    smooth = around.nanmean(1)
    noise = NORMAL_OVER_MAD * (off - smooth).abs().nanmedian()
    departs = smooth * (1 - (_SIGNIFICANT * noise / smooth.abs().clamp(min=1e-12)) ** 4).clamp(min=0)
    height = profile.height.clone()
    height[shown] -= (distance.value - departs[shown]) / distance.cosine
    return reference_of(profile.origin_mm, profile.step_mm, height)
