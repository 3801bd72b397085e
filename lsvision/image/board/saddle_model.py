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
POSITION = slice(0, 2)


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
        return self.columns[:, 4]

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
class BlurredEdge:
    """Unit edge through the corner at every pixel, and its derivatives.

    Across an edge, a square pixel is the sum of two boxes, ``|cos|`` and ``|sin|`` of the normal's angle wide. The
    wider one is integrated exactly, of the other its variance is added to the blur: with ``H' = erf``, the edge is
    ``(H(d + w/2) - H(d - w/2)) / w``.
    """

    value: Float[Tensor, "corners pixels"]
    slope: Float[Tensor, "corners pixels"]
    """Derivative of the value by the distance from the edge, 1/px."""
    by_blur: Float[Tensor, "corners pixels"]
    """Derivative by the blur, 1/px."""
    by_angle: Float[Tensor, "corners pixels"]
    """Derivative by the angle of the normal, 1/rad."""
    normal: Float[Tensor, "2 corners 1"]
    across: Float[Tensor, "corners pixels"]
    """Distance from the edge, px."""
    blur: Float[Tensor, "corners 1"]
    """Of the lens, px."""

    @classmethod
    def through_corner(cls, u: Tensor, v: Tensor, angle: Tensor, blur: Tensor) -> "BlurredEdge":
        """Edges at offsets (u, v) from their corners, px; ``angle`` and ``blur`` have the shape (corners, 1)."""
        cosine, sine = torch.cos(angle), torch.sin(angle)
        across, along = u * cosine + v * sine, v * cosine - u * sine
        upright = cosine.abs() >= sine.abs()
        width = torch.where(upright, cosine.abs(), sine.abs())
        width_by_angle = torch.where(upright, -cosine.sign() * sine, sine.sign() * cosine)
        total = (blur.square() + (1 - width.square()) * PIXEL_VARIANCE).sqrt()
        ends = across + width / 2, across - width / 2
        step, bell = zip(*(_erf_and_bell(end, total) for end in ends), strict=True)
        by_total = (bell[0] - bell[1]) / width
        value = (ends[0] * step[0] - ends[1] * step[1]) / width + total * by_total
        slope = (step[0] - step[1]) / width
        by_width = ((step[0] + step[1]) / 2 - value) / width - by_total * (PIXEL_VARIANCE * width / total)
        return cls(
            value=value,
            slope=slope,
            by_blur=by_total * (blur / total),
            by_angle=slope * along + by_width * width_by_angle,
            normal=torch.stack([cosine, sine]),
            across=across,
            blur=blur,
        )

    def by_kurtosis(self) -> Float[Tensor, "corners pixels"]:
        """Change of the value where the blur has other tails than a bell: the next term of Edgeworth's series."""
        scaled = self.across / (self.blur.square() + PIXEL_VARIANCE).sqrt()
        return scaled * (scaled.square() - 3) * torch.exp(-scaled.square() / 2)


def _erf_and_bell(distance: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """``erf(d / √2 s)``, and its derivative by d times s."""
    scaled = distance / (math.sqrt(2.0) * blur)
    return torch.erf(scaled), math.sqrt(2.0 / math.pi) * torch.exp(-scaled.square())


@dataclass(frozen=True)
class Saddle:
    """Saddles on a grid of pixels, as the parts that their values and derivatives share."""

    edges: tuple[BlurredEdge, BlurredEdge]
    plane: Float[Tensor, "3 pixels"]
    """1, u and v."""
    levels: Float[Tensor, "corners 4 pixels"]
    """A0 to A3."""
    shapes: Float[Tensor, "corners 4 pixels"]
    """1, E1, E2, E1 E2."""

    @classmethod
    def on_grid(cls, parameters: SaddleParameters, grid: Float[Tensor, "2 pixels"]) -> "Saddle":
        """Saddles at the (u, v) of a grid, px from the windows' centres."""
        blur = parameters.blur[:, None]
        u, v = grid[0] - parameters.position[:, :1], grid[1] - parameters.position[:, 1:]
        first, second = (
            BlurredEdge.through_corner(u, v, angle[:, None], blur) for angle in parameters.angles.unbind(-1)
        )
        plane = torch.cat([torch.ones_like(grid[:1]), grid])
        shapes = torch.stack([torch.ones_like(u), first.value, second.value, first.value * second.value], dim=1)
        return cls((first, second), plane, parameters.levels @ plane, shapes)

    def values(self) -> Float[Tensor, "corners pixels"]:
        """Grey values."""
        return (self.levels * self.shapes).sum(1)

    def steps(self) -> Float[Tensor, "corners 2 pixels"]:
        """Half the change of the grey values across either edge."""
        first, second = self.edges
        _, a1, a2, a3 = self.levels.unbind(1)
        return torch.stack([a1 + a3 * second.value, a2 + a3 * first.value], dim=1)

    def jacobian(self, model: SaddleModel) -> Float[Tensor, "corners free pixels"]:
        """Derivative of the grey values by the free parameters of a model."""
        first, second = self.edges
        weight_1, weight_2 = self.steps().unbind(1)
        slope_1, slope_2 = weight_1 * first.slope, weight_2 * second.slope
        by_shape = [
            -(slope_1 * first.normal[0] + slope_2 * second.normal[0]),
            -(slope_1 * first.normal[1] + slope_2 * second.normal[1]),
            weight_1 * first.by_angle,
            weight_2 * second.by_angle,
            weight_1 * first.by_blur + weight_2 * second.by_blur,
        ]
        by_levels = [self.shapes[:, level] * self.plane[term] for level, term in model.free_levels]
        return torch.stack([*by_shape, *by_levels], dim=1)

    def other_shapes(self) -> Float[Tensor, "corners 5 pixels"]:
        """Differences of real pictures from the model, which turn with the picture and so move no corner.

        Brightness that is no linear function of the light (squares and cubes of the grey values), another blur across
        one edge than across the other, and blurs that are no bell.
        """
        first, second = self.edges
        weight_1, weight_2 = self.steps().unbind(1)
        values = self.values()
        centred = values - values.mean(-1, keepdim=True)
        return torch.stack(
            [
                centred.square(),
                centred.square() * centred,
                weight_1 * first.by_blur,
                weight_1 * first.by_kurtosis(),
                weight_2 * second.by_kurtosis(),
            ],
            dim=1,
        )
