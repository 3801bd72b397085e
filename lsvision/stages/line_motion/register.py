"""Lines -> their displacement against the reference profile: robust Gauss-Newton on all lines as one batch.

The residual of a sample is r = h - H(q_x), with (q_x, h) where it lies in the product once its line is turned and
shifted back by (δx, δz, ρ). With g = (∂r/∂x', ∂r/∂z') its derivatives by the place in the line,

    ∂r/∂δx = -(cos ρ g_x + sin ρ g_z),   ∂r/∂δz = sin ρ g_x - cos ρ g_z,   ∂r/∂ρ = g_z (x' - c_x) - g_x (z' - c_z),

and an error of the depth moves r by g along the ray. Weights are Tukey's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from lsvision.geometry import ProductFrame, line_axes, middle_point
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.profiles import LineSamples, Reference

# Standard deviations of displacements that no data restrict: mm, mm, rad. They keep the equations solvable.
LOOSE_SIGMA = (10.0, 10.0, 0.1)
_COARSE_MM = (4.0, 1.0)  # distances beyond which samples do not count in the first steps
_LEAST_SIGMA_MM = 1e-3  # of a residual
_PIECE_PX = 32  # columns that fall to one half, then to the other: matching errs alike over some 20


@dataclass(frozen=True)
class Registered:
    """Displacement (δx, δz, ρ) of lines, and the information on it that independent samples would give.

    ``samples`` is how many took part. ``difference`` is that of the displacements that two halves of the columns give,
    and ``difference_variance`` what independent samples would make of it: no motion is in it, errors alone.
    """

    values: Float[Tensor, "lines 3"]
    information: Float[Tensor, "lines 3 3"]
    samples: Int[Tensor, " lines"]
    difference: Float[Tensor, "lines 3"]
    difference_variance: Float[Tensor, "lines 3"]

    @property
    def covariance(self) -> Float[Tensor, "lines 3 3"]:
        """Of the displacements, as independent samples would give; that of nothing known where nothing shows them."""
        return torch.linalg.inv(self.information + _loose(self.values))

    @classmethod
    def joined(cls, parts: Sequence["Registered"]) -> "Registered":
        """Those of several ranges of lines, one after the other."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    @classmethod
    def nothing(cls, lines: int) -> "Registered":
        """Lines of which nothing is known yet.

        Small results of many blocks, kept as they come, would hold the memory of what was freed between them.
        """
        zeros = torch.zeros(lines, 3, dtype=torch.float64)
        return cls(zeros, zeros[..., None].repeat(1, 1, 3), zeros[:, 0].long(), zeros.clone(), zeros.clone())

    def put(self, start: int, part: "Registered") -> None:
        """Write the lines from ``start`` on."""
        for field in fields(self):
            getattr(self, field.name)[start : start + len(part.values)] = getattr(part, field.name)


def placed(
    samples: LineSamples, values: Float[Tensor, "lines 3"], frame: ProductFrame
) -> tuple[Float[Tensor, "lines columns"], Float[Tensor, "lines columns"]]:
    """(q_x, height), mm, of samples whose lines are displaced by ``values``."""
    axes = line_axes(frame.axes, pad(values, (0, 1)), middle_point(frame.rig))
    q_x, q_z = (
        torch.addcmul(
            axes.origin[:, i, None],
            samples.z,
            torch.addcmul(
                axes.ahead[:, i, None] + samples.plane_slope * frame.axes[i, 1], samples.slope, axes.across[:, i, None]
            ),
        )
        for i in (0, 2)
    )
    return q_x, frame.height_datum_mm - q_z


def register(
    samples: LineSamples,
    start: Float[Tensor, "lines 3"],
    reference: Reference,
    frame: ProductFrame,
    config: LineMotionConfig,
) -> Registered:
    """Register lines to a reference profile.

    Args:
        start: displacements to start from; a median of the residuals is added to their δz.
    """
    q_x, height = placed(samples, start, frame)
    rise = (height - reference.at(q_x)[0]).nanmedian(dim=1).values.nan_to_num()
    values = start - rise[:, None] * start.new_tensor([0.0, 1.0, 0.0])
    loose = _loose(values)
    for step in range(config.iterations + len(_COARSE_MM)):
        equations = equations_of(samples, values, reference, frame)
        cut = _COARSE_MM[step] if step < len(_COARSE_MM) else config.cut_sigma * equations.sigma
        normal = equations.weighted(cut)
        values = values - torch.linalg.solve(normal.information + loose, normal.slope)
    equations = equations_of(samples, values, reference, frame)
    difference, variance = torch.zeros_like(values), torch.zeros_like(values)
    half = (samples.columns - samples.columns[0]) // _PIECE_PX % 2
    for side, sign in ((0, 1.0), (1, -1.0)):
        part = equations.weighted(config.cut_sigma * equations.sigma, half == side)
        covariance = torch.linalg.inv(part.information + loose)
        difference = difference - sign * (covariance @ part.slope[..., None])[..., 0]
        variance = variance + covariance.diagonal(dim1=-2, dim2=-1)
    return Registered(values, normal.information, normal.used.sum(1), difference, variance)


def _loose(values: Tensor) -> Tensor:
    """Information that lets every displacement go."""
    return torch.diag(values.new_tensor(LOOSE_SIGMA) ** -2)


@dataclass(frozen=True)
class NormalEquations:
    """Jᵀ W J and Jᵀ W r of every line, and the samples that take part."""

    information: Float[Tensor, "lines 3 3"]
    slope: Float[Tensor, "lines 3"]
    used: Bool[Tensor, "lines columns"]


@dataclass(frozen=True)
class Equations:
    """Residuals of samples, their standard deviations, and their derivatives by the displacement of the line."""

    residual: Float[Tensor, "lines columns"]
    sigma: Float[Tensor, "lines columns"]
    by_motion: tuple[Tensor, Tensor, Tensor]

    def weighted(self, cut: Tensor | float, among: Bool[Tensor, " columns"] | None = None) -> NormalEquations:
        """The normal equations of all columns or some; samples beyond ``cut``, mm, do not count."""
        inside = (1 - (self.residual / cut).square()).clamp(min=0)  # NaN where nothing was measured
        weight = (inside / self.sigma).square()
        used = weight > 0 if among is None else (weight > 0) & among
        weight, residual = weight.masked_fill(~used, 0.0), self.residual.masked_fill(~used, 0.0)
        rows = [by.masked_fill(~used, 0.0) for by in self.by_motion]
        heavy = [row * weight for row in rows]
        information = torch.stack([torch.stack([(a * b).sum(1) for b in rows], -1) for a in heavy], -2)
        return NormalEquations(information, torch.stack([(a * residual).sum(1) for a in heavy], -1), used)


def equations_of(samples: LineSamples, values: Tensor, reference: Reference, frame: ProductFrame) -> Equations:
    """The equations of lines at displacements."""
    q_x, height = placed(samples, values, frame)
    level, slope = reference.at(q_x)
    axes, pivot = frame.axes, middle_point(frame.rig)
    cos, sin = torch.cos(values[:, 2, None]), torch.sin(values[:, 2, None])
    g_x, g_z = (-axes[2, i] - slope * axes[0, i] for i in (0, 2))
    x = samples.slope * samples.z - pivot[0] - values[:, 0, None]
    z = samples.z - pivot[2] - values[:, 1, None]
    by_x, by_z = -(cos * g_x + sin * g_z), sin * g_x - cos * g_z
    by_roll = by_x * z - by_z * x  # with the place before the turn it needs no sine
    along_ray = samples.slope * by_x + by_z  # what -1 mm of depth does
    sigma = (samples.sigma * along_ray.abs()).clamp(min=_LEAST_SIGMA_MM)
    return Equations(height - level, sigma, (by_x, by_z, by_roll))
