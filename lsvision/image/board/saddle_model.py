"""The picture of a checkerboard corner: two blurred edges that cross, and its derivative by every parameter.

``A0 + A1 E1 + A2 E2 + A3 E1 E2``, ``Ek`` is the mean of ``erf(d / √2 s)`` over a pixel: d is the distance from an edge,
s is the blur of the lens. Each level ``Ak = a + b u + c v`` has a gradient, so that every quadrant has a level and a
gradient: light falls off, print and paper are not even.

A pixel that is taken for a point with more blur puts the corners of a sharp board that stands straight on the sensor up
to 0.06 px off, towards the middle or the rim of their pixels.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_FIRST_LEVEL = 5  # parameters that enter non-linearly come first
_LEVELS, _TERMS = 4, 3
PARAMETERS = _FIRST_LEVEL + _LEVELS * _TERMS
POSITION, BLUR = slice(0, 2), 4
_LEAST_EXPONENT = -40.0  # 4e-18 is 0 beside 1; products of smaller numbers become denormal, which takes far longer


@dataclass(frozen=True)
class SaddleParameters:
    """Parameters of saddles as columns: position (2), angles (2), blur, then (1, u, v) of each of the four levels."""

    columns: Float[Tensor, "corners 17"]

    @classmethod
    def at_centre(
        cls, angles: Float[Tensor, "corners 2"], offset: Float[Tensor, " corners"], contrast: Float[Tensor, " corners"]
    ) -> "SaddleParameters":
        """Saddles in the middle of their windows, of one pixel's blur and even squares."""
        parameters = cls(offset.new_zeros(len(offset), PARAMETERS))
        parameters.angles.copy_(angles)
        parameters.blur.fill_(1.0)
        parameters.levels[:, 0, 0].copy_(offset)
        parameters.contrast.copy_(contrast)
        return parameters

    @property
    def position(self) -> Float[Tensor, "corners 2"]:
        """Corner as (u, v) from the window's centre, px."""
        return self.columns[:, POSITION]

    @property
    def angles(self) -> Float[Tensor, "corners 2"]:
        """Direction of the normal of each edge, rad from u towards v."""
        return self.columns[:, 2:4]

    @property
    def blur(self) -> Float[Tensor, " corners"]:
        """Standard deviation of the blur of the lens, px."""
        return self.columns[:, BLUR]

    @property
    def levels(self) -> Float[Tensor, "corners 4 3"]:
        """Coefficients of (1, u, v) in A0 to A3."""
        return self.columns[:, _FIRST_LEVEL:].unflatten(-1, (_LEVELS, _TERMS))

    @property
    def contrast(self) -> Float[Tensor, " corners"]:
        """Constant part of A3: half the step from a dark to a bright square, negative where E1 E2 > 0 is dark."""
        return self.levels[:, 3, 0]


@dataclass(frozen=True)
class SaddleModel:
    """Levels that a fit may change, as (level, term of (1, u, v)); position, angles and blur are always free."""

    free_levels: tuple[tuple[int, int], ...]

    @property
    def free(self) -> list[int]:
        """Columns of the free parameters."""
        return [*range(_FIRST_LEVEL), *(_FIRST_LEVEL + _TERMS * level + term for level, term in self.free_levels)]


PLAIN = SaddleModel(((0, 0), (0, 1), (0, 2), (3, 0)))
"""``b + g·(u, v) + c E1 E2``: it has few minima."""
FULL = SaddleModel(tuple(itertools.product(range(_LEVELS), range(_TERMS))))
PIXEL_VARIANCE = 1 / 12
"""Of a point within its pixel along any direction, px²."""


@dataclass(frozen=True)
class BlurredEdges:
    """Unit edges through corners at every pixel, and their derivatives.

    Across an edge, a square pixel is the sum of two boxes, ``|cos|`` and ``|sin|`` of the normal's angle wide. The
    wider one is integrated exactly, of the other its variance is added to the blur: with ``H' = erf``, the edge is
    ``(H(d + w/2) - H(d - w/2)) / w``.
    """

    value: Float[Tensor, "corners edges pixels"]
    slope: Float[Tensor, "corners edges pixels"]
    """Derivative of the value by the distance from the edge, 1/px."""
    by_blur: Float[Tensor, "corners edges pixels"]
    """Derivative by the blur, 1/px."""
    by_angle: Float[Tensor, "corners edges pixels"]
    """Derivative by the angle of the normal, 1/rad."""
    normal: Float[Tensor, "corners edges 2"]
    across: Float[Tensor, "corners edges pixels"]
    """Distance from the edge, px."""
    blur: Float[Tensor, "corners 1"]
    """Of the lens, px."""

    @classmethod
    def through_corners(
        cls,
        position: Float[Tensor, "corners 2"],
        angles: Float[Tensor, "corners edges"],
        blur: Float[Tensor, " corners"],
        grid: Float[Tensor, "2 pixels"],
    ) -> "BlurredEdges":
        """Edges at the (u, v) of a grid; a corner's position is given on the grid, ``angles`` are of the normals."""
        cosine, sine = torch.cos(angles), torch.sin(angles)
        normal, tangent = torch.stack([cosine, sine], dim=-1), torch.stack([-sine, cosine], dim=-1)
        upright = cosine.abs() >= sine.abs()
        width = torch.where(upright, cosine.abs(), sine.abs())
        width_by_angle = torch.where(upright, -cosine.sign() * sine, sine.sign() * cosine)
        total = (blur[:, None].square() + (1 - width.square()) * PIXEL_VARIANCE).sqrt()
        reach = math.sqrt(2.0) * total
        # All four are linear in (u, v): one product instead of twelve passes over the pixels.
        across, along, *ends = _linear_on_grid(
            torch.stack([normal, tangent, normal / reach[..., None], normal / reach[..., None]]),
            torch.stack([torch.zeros_like(width), torch.zeros_like(width), width / reach / 2, -width / reach / 2]),
            position,
            grid,
        )
        ahead, behind = (_Step.at(end) for end in ends)
        width, reach = width[..., None], reach[..., None]
        value = (ahead.integral - behind.integral).mul_(reach / width)
        slope = (ahead.value - behind.value).div_(width)
        by_total = (ahead.bell - behind.bell).mul_(math.sqrt(2.0 / math.pi) / width)
        # by width: ((ahead + behind) / 2 - value) / width - by_total * PIXEL_VARIANCE * width / total
        turn = width_by_angle[..., None] / width
        by_angle = (slope * along).addcmul_(ahead.value + behind.value, turn / 2).addcmul_(value, -turn)
        by_angle.addcmul_(by_total, -turn * PIXEL_VARIANCE * width.square() / total[..., None])
        return cls(value, slope, by_total * (blur[:, None] / total)[..., None], by_angle, normal, across, blur[:, None])

    def by_kurtosis(self) -> Float[Tensor, "corners edges pixels"]:
        """Change of the value where the blur has other tails than a bell: the next term of Edgeworth's series."""
        scaled = self.across / (self.blur.square() + PIXEL_VARIANCE).sqrt()[..., None]
        square = scaled.square()
        return scaled * (square - 3) * _bell(square / 2)


@dataclass(frozen=True)
class _Step:
    """``erf``, its integral, and the bell ``exp(-x²)`` at distances x."""

    value: Tensor
    integral: Tensor
    bell: Tensor

    @classmethod
    def at(cls, distance: Tensor) -> "_Step":
        step, bell = torch.erf(distance), _bell(distance.square())
        return cls(step, torch.addcmul(bell / math.sqrt(math.pi), distance, step), bell)


def _bell(square: Tensor) -> Tensor:
    """``exp(-square)``."""
    return torch.exp((-square).clamp_(min=_LEAST_EXPONENT))


def _linear_on_grid(
    slopes: Float[Tensor, "functions corners edges 2"],
    constants: Float[Tensor, "functions corners edges"],
    position: Float[Tensor, "corners 2"],
    grid: Float[Tensor, "2 pixels"],
) -> tuple[Float[Tensor, "corners edges pixels"], ...]:
    """Linear functions that have given values at the corners."""
    offset = constants - (slopes @ position[:, :, None])[..., 0]
    return torch.unbind(torch.cat([offset[..., None], slopes], dim=-1) @ _plane(grid))


def _plane(grid: Float[Tensor, "2 pixels"]) -> Float[Tensor, "3 pixels"]:
    """1, u and v."""
    return torch.cat([torch.ones_like(grid[:1]), grid])


@dataclass(frozen=True)
class Saddle:
    """Saddles on a grid of pixels, as the parts that their values and derivatives share."""

    edges: BlurredEdges
    plane: Float[Tensor, "3 pixels"]
    """1, u and v."""
    levels: Float[Tensor, "corners 4 pixels"]
    """A0 to A3."""
    shapes: Float[Tensor, "corners 4 pixels"]
    """1, E1, E2, E1 E2."""

    @classmethod
    def on_grid(cls, parameters: SaddleParameters, grid: Float[Tensor, "2 pixels"]) -> "Saddle":
        """Saddles at the (u, v) of a grid, px from the windows' centres."""
        edges = BlurredEdges.through_corners(parameters.position, parameters.angles, parameters.blur, grid)
        first, second = edges.value.unbind(1)
        shapes = torch.stack([torch.ones_like(first), first, second, first * second], dim=1)
        plane = _plane(grid)
        return cls(edges, plane, parameters.levels @ plane, shapes)

    def values(self) -> Float[Tensor, "corners pixels"]:
        """Grey values."""
        return (self.levels * self.shapes).sum(1)

    def steps(self) -> Float[Tensor, "corners 2 pixels"]:
        """Half the change of the grey values across either edge."""
        return torch.addcmul(self.levels[:, 1:3], self.levels[:, 3:], self.edges.value.flip(1))

    def jacobian(
        self, model: SaddleModel, weight: Float[Tensor, "corners pixels"] | None = None
    ) -> Float[Tensor, "corners free pixels"]:
        """Derivative of the grey values, times a weight, by the free parameters of a model."""
        steps, shapes = self.steps(), self.shapes
        if weight is not None:
            steps, shapes = steps * weight[:, None], shapes * weight[:, None]
        jacobian = steps.new_empty(len(steps), len(model.free), steps.shape[-1])
        torch.matmul(-self.edges.normal.mT, steps * self.edges.slope, out=jacobian[:, POSITION])
        torch.mul(steps, self.edges.by_angle, out=jacobian[:, 2:4])
        torch.sum(steps * self.edges.by_blur, 1, out=jacobian[:, BLUR])
        for row, (level, term) in enumerate(model.free_levels, start=_FIRST_LEVEL):
            torch.mul(shapes[:, level], self.plane[term], out=jacobian[:, row])
        return jacobian

    def other_shapes(self) -> Float[Tensor, "corners 5 pixels"]:
        """Differences of real pictures from the model, which turn with the picture and so move no corner.

        Brightness that is no linear function of the light (squares and cubes of the grey values), another blur across
        one edge than across the other, and blurs that are no bell.
        """
        steps = self.steps()
        values = self.values()
        centred = values - values.mean(-1, keepdim=True)
        square = centred.square()
        by_first_blur = steps[:, :1] * self.edges.by_blur[:, :1]
        return torch.cat(
            [torch.stack([square, square * centred], dim=1), by_first_blur, steps * self.edges.by_kurtosis()], dim=1
        )
