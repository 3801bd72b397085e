"""Lines of one colour -> their displacement, by least squares on the grey values of both cameras.

The reference profile, displaced as the line was registered, says which columns of the two images show the same point.
What is left between them, e = right - left, is explained by a displacement θ beyond that,

    e = s J θ + g L + noise,

with s the slope of the left line, J = ∂disparity/∂θ, L the left line itself and g a difference of gain, all less their
means over the columns around. All columns of a line have one θ, and the noise of the slope, which would pull θ towards
zero, is taken out of the normal equations: windows of little texture hold nothing back. Weights are Tukey's.

Source: Lucas & Kanade 1981; Gruen 1985 (brightness); Fuller 1987, Measurement Error Models, sec. 2.2 (noise of s).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.geometry import depth_sigma, disparity_at
from lsvision.image.stereo.shift import SLOPE_NOISE
from lsvision.image.stereo.warp import warp_cubic
from lsvision.image.stereo.windows import row_window_sum
from lsvision.stages.line_motion.color_pair import ColorPair
from lsvision.stages.line_motion.profiles import LineSamples, Reference
from lsvision.stages.line_motion.register import Registered, equations_of

_PIECE_PX = 32  # columns that fall to one half, then to the other
_AROUND_PX = 31  # columns over which means are taken
_STEPS = 3
_TUKEY = 4.685  # standard deviations: 95 % as good as least squares where there are no outliers
_LEAST_SHARE = 0.2  # of the slopes that is no noise, and of the weights that outliers leave, at least
_LEAST_SIGMA = 0.3  # grey values: rounding alone
_THINNED = 4  # every fourth column shows how large most residuals are
_TINY = 1e-9
# Information beforehand on (δx, δz, ρ) in mm, mm and rad, and on the gain: it keeps the equations solvable.
_PRIOR = torch.diag(torch.tensor([10.0, 10.0, 0.1, 0.3], dtype=torch.float64) ** -2)


def register_color(
    pair: ColorPair,
    channel: int,
    start: int,
    samples: LineSamples,
    values: Float[Tensor, "rows 3"],
    shown: tuple[Reference, float],
) -> Registered:
    """Displacement of the rows from ``start`` on in one colour.

    Args:
        samples: of all columns of a range, of the same rows. values: displacement of the rows, as registered.
        shown: the reference profile, and how many standard deviations of its own a sample may lie off it.
    """
    rows = _Rows.of(pair, channel, start, samples, values, shown)
    moved = torch.zeros_like(values)
    for _ in range(_STEPS):
        fit = rows.at(moved).fit(rows.valid)
        moved = moved + fit.step
    half = torch.arange(rows.valid.shape[1]) // _PIECE_PX % 2
    left_over = rows.at(moved)
    one, other = (left_over.fit(rows.valid & (half == side)) for side in range(2))
    # The weights of outliers follow a step; what they would make of it is part of it.
    difference = (one.step - other.step) / left_over.steadiness[:, None]
    variance = (one.covariance + other.covariance).diagonal(dim1=-2, dim2=-1)
    return Registered(values + moved, torch.linalg.inv(fit.covariance), rows.valid.sum(1), difference, variance)


@dataclass(frozen=True)
class _RowFit:
    """A further step of the displacement of each row, and the covariance of it."""

    step: Float[Tensor, "rows 3"]
    covariance: Float[Tensor, "rows 3 3"]


@dataclass(frozen=True)
class _Residuals:
    """What is left between the images, as in ``_Rows``; ``sigma`` of each row, and roots of the weights of samples."""

    residual: Float[Tensor, "rows columns"]
    changes: Float[Tensor, "rows columns 4"]
    slope: Float[Tensor, "rows columns"]
    sigma: Float[Tensor, "rows 1"]
    root: Float[Tensor, "rows columns"]

    @property
    def steadiness(self) -> Float[Tensor, " rows"]:
        """Mean derivative of Tukey's influence over the mean weight."""
        off = (self.residual / (_TUKEY * self.sigma)).square()
        bend = (self.root * (1 - 5 * off)).sum(1) / self.root.square().sum(1).clamp(min=_TINY)
        return bend.clamp(_LEAST_SHARE, 1.0).double()

    def fit(self, among: Bool[Tensor, "rows columns"]) -> _RowFit:
        """A step by some columns."""
        root = self.root * among
        J, variance = self.changes * root[..., None], self.sigma.double().square()[..., None]
        normal = (J.mT @ J).double() / variance + _PRIOR
        pull = (J.mT @ (root * self.residual)[..., None]).double() / variance
        noise = SLOPE_NOISE * self.sigma.square() * root.square().sum(1, keepdim=True)
        slopes = (root * self.slope).square().sum(1, keepdim=True).clamp(min=_TINY)
        share = (1 - noise / slopes).clamp(_LEAST_SHARE, 1.0).double()
        step = torch.linalg.solve(normal, pull)[:, :3, 0] / share
        return _RowFit(step, torch.linalg.inv(normal)[:, :3, :3] / share[..., None].square())


@dataclass(frozen=True)
class _Rows:
    """Grey values of some rows, and which columns of the two images belong together.

    Attributes:
        left, right: grey values, the right ones of whole lines. slope: of the left lines, less its mean around.
        disparity: of the reference profile. by_motion: its derivative by the displacement, px per mm or rad.
        changes: of the residual with (δx, δz, ρ) and the gain. valid: where the profile was measured.
    """

    left: Float[Tensor, "rows columns"]
    right: Float[Tensor, "rows width"]
    slope: Float[Tensor, "rows columns"]
    disparity: Float[Tensor, "rows columns"]
    by_motion: Float[Tensor, "rows columns 3"]
    changes: Float[Tensor, "rows columns 4"]
    valid: Bool[Tensor, "rows columns"]
    first_column: int

    @classmethod
    def of(
        cls,
        pair: ColorPair,
        channel: int,
        start: int,
        samples: LineSamples,
        values: Tensor,
        shown: tuple[Reference, float],
    ) -> "_Rows":
        """Those of one colour."""
        reference, cut_sigma = shown
        equations = equations_of(samples, values, reference, pair.frame)
        along_ray = samples.slope * equations.by_motion[0] + equations.by_motion[1]
        z = samples.z + equations.residual / along_ray
        per_px, disparity = depth_sigma(pair.scan.rig, z, 1.0), disparity_at(pair.scan.rig, z)
        by_motion = torch.stack([-by / along_ray / per_px for by in equations.by_motion], -1)
        stop, first, last = start + len(values), int(samples.columns[0]), int(samples.columns[-1]) + 1
        left, right = pair.left(channel, start, stop)[:, first:last], pair.right(channel, start, stop)
        valid = equations.residual.abs() <= cut_sigma * equations.sigma  # not where it was not measured
        partner = torch.arange(first, last) - disparity
        valid &= (partner >= 1) & (partner <= right.shape[1] - 2)
        slope = _centred(pad(left[:, 2:] - left[:, :-2], (1, 1)) / 2, valid)
        by_motion = by_motion.masked_fill(~valid[..., None], 0.0).float()
        changes = torch.cat([slope[..., None] * by_motion, _centred(left, valid)[..., None]], -1)
        disparity = disparity.masked_fill(~valid, 0.0).float()
        return cls(left, right, slope, disparity, by_motion, changes, valid, first)

    def at(self, displacement: Float[Tensor, "rows 3"]) -> _Residuals:
        """What is left at a displacement."""
        moved = self.disparity + (self.by_motion * displacement.float()[:, None]).sum(-1)
        residual = _centred(warp_cubic(self.right, moved, self.first_column) - self.left, self.valid)
        off = residual.abs().masked_fill(~self.valid, torch.nan)[:, ::_THINNED].nanmedian(1, keepdim=True).values
        sigma = (NORMAL_OVER_MAD * off).nan_to_num(1.0).clamp(min=_LEAST_SIGMA)
        root = (1 - (residual / (_TUKEY * sigma)).square()).clamp(min=0) * self.valid
        return _Residuals(residual, self.changes, self.slope, sigma, root)


def _centred(values: Float[Tensor, "rows columns"], valid: Bool[Tensor, "rows columns"]) -> Tensor:
    """Values less their mean over the valid columns around; zero elsewhere."""
    weight = valid.to(values)
    total, count = (row_window_sum(part, _AROUND_PX) for part in (values * weight, weight))
    return (values - total / count.clamp(min=1.0)) * weight
