"""How much brighter or darker the right image of a pair is than the left one, column by column.

Two cameras differ by exposure, gain, black level and tone curve, and each darkens towards the ends of its lines. None
of it changes from line to line, and along a line only the gain does. So the left value of a matched pixel is taken for

    gain(u) (right + curve right² / 255) + offset

with a gain that is linear between a few columns u of the right image: light is lost before the tone curve. The fit, by
Gauss-Newton steps, is robust: where a camera sees a gloss that the other does not, or a match is wrong, pixels lose
their weight. Where the object is of almost one brightness, a gloss may still pass for a tone curve that no camera has:
then the fit is made without a curve, and given up where that is no better.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

_NODES = 13  # columns between which the gain is linear
_ROUNDS, _NARROWER = 20, 0.8  # steps, and what each leaves of the distance beyond which a pixel is an outlier
_FIRST_OUTLIER, _OUTLIER = 16.0, 4.0  # robust standard deviations at which a pixel has no weight (Tukey's biweight)
_LEAST_SPREAD = 2.0  # grey values: what straight pieces of a curved gain may be off
_LEAST_PIXELS, _MOST_PIXELS, _FEW_PIXELS = 400, 10_000, 20
_EQUAL = 1.0  # rms change of grey values, of 255, below which images are as bright as each other
# What cameras may differ by.
_GAINS, _LARGEST_OFFSET, _CURVES = (0.25, 4.0), 64.0, (-0.4, 1.5)
_ALIKE = 1.0  # weight, in pixels, of gains that are alike from node to node


@dataclass(frozen=True)
class Exposure:
    """What turns the brightness of a right image, of 255, into that of the left one.

    Args:
        gain: at equal distances from the first to the last column.
        offset: grey values.
        curve: of the squared brightness, over 255, beside the brightness itself.
    """

    gain: Float[Tensor, " nodes"]
    offset: float
    curve: float

    @property
    def is_plausible(self) -> bool:
        """Whether two cameras may differ by this much."""
        low, high = (float(limit) for limit in torch.aminmax(self.gain))
        gains = _GAINS[0] <= low and high <= _GAINS[1]
        return gains and abs(self.offset) <= _LARGEST_OFFSET and _CURVES[0] <= self.curve <= _CURVES[1]

    def change(self, right: Float[Tensor, " pixels"], position: Float[Tensor, " pixels"]) -> Float[Tensor, " pixels"]:
        """What is added to a brightness of 1, at positions 0..1 along the line."""
        straight = right + self.curve * right.square()
        return (_between(position) @ self.gain) * straight + self.offset / 255.0 - right

    def apply(self, right: Shaped[Tensor, "lines width"]) -> Float[Tensor, "lines width"]:
        """Brightness of the left camera for that of the right one, float32, 0..255."""
        gain = _between(torch.linspace(0, 1, right.shape[1], dtype=torch.float64)) @ self.gain
        values = right.to(torch.float32)
        straight = values.mul(self.curve / 255.0).add_(1.0).mul_(values)
        return straight.mul_(gain.to(torch.float32)).add_(self.offset).clamp_(0.0, 255.0)


def fit_exposure(
    left: Float[Tensor, " pixels"], right: Float[Tensor, " pixels"], position: Float[Tensor, " pixels"]
) -> Exposure | None:
    """The exposure of a right image relative to the left one from matched pixels.

    Args:
        left, right: brightness of the same places in both images, of 255, smoothed over a few pixels: noise of the
            right one would lower its gain.
        position: of the pixels in the right image, 0 for its first column, 1 for its last.

    Returns:
        None where the images are as bright as each other, or too few pixels match.
    """
    if len(left) < _LEAST_PIXELS:
        return None
    every = -(-len(left) // _MOST_PIXELS)
    left, right, position = (values[::every].double() / 255.0 for values in (left, right, 255.0 * position))
    target = left - right
    if _rms(target) <= _EQUAL:
        return None
    for with_curve in (True, False):
        found = _fit(left, right, position, with_curve=with_curve)
        if found.is_plausible:
            return found if _rms(found.change(right, position)) > _EQUAL else None
    return None


def _fit(left: Tensor, right: Tensor, position: Tensor, *, with_curve: bool) -> Exposure:
    """The exposure by robust Gauss-Newton steps; brightness of 1."""
    hats, target = _between(position), left - right
    steps = _ALIKE**0.5 * torch.eye(_NODES, _NODES + 2, dtype=torch.float64).diff(dim=0)
    found = Exposure(_first_gain(left, right, position), 0.0, 0.0)
    for number in range(_ROUNDS):
        straight, factor = right + found.curve * right.square(), hats @ found.gain
        residual = target - found.change(right, position)
        spread = (residual.abs().median() / 0.6745).clamp(min=_LEAST_SPREAD / 255.0)
        outlier = spread * max(_OUTLIER, _FIRST_OUTLIER * _NARROWER**number)
        weight = (1 - (residual / outlier).square()).clamp(min=0).square()
        design = torch.stack([torch.ones_like(right), factor * right.square() * float(with_curve)], 1)
        design = torch.cat([hats * straight[:, None], design], 1)
        normal = design.mT @ (weight[:, None] * design) + steps.mT @ steps
        normal[-1, -1] += float(not with_curve)
        pull = design.mT @ (weight * residual) - steps.mT @ (steps[:, :_NODES] @ found.gain)
        step = torch.linalg.lstsq(normal, pull).solution
        offset = found.offset + 255.0 * float(step[_NODES])
        found = Exposure(found.gain + step[:_NODES], offset, found.curve + float(step[_NODES + 1]))
    return found


def _first_gain(left: Tensor, right: Tensor, position: Tensor) -> Tensor:
    """The usual ratio of brightness around each node, where a few pixels show it; elsewhere that of all."""
    ratio, nearest = left / right.clamp(min=1.0 / 255.0), (position * (_NODES - 1)).round()
    gains = []
    for node in range(_NODES):
        near = ratio[nearest == node]
        gains.append((near if len(near) >= _FEW_PIXELS else ratio).median())
    return torch.stack(gains)


def _rms(values: Tensor) -> float:
    """Root mean square of brightnesses of 1, in grey values of 255."""
    return 255.0 * float(values.square().mean().sqrt())


def _between(position: Tensor) -> Tensor:
    """Weights of the nodes, ``(pixels, nodes)``, at positions 0..1."""
    nodes = torch.linspace(0, 1, _NODES, dtype=position.dtype)
    return (1 - (position[:, None] - nodes).abs() * (_NODES - 1)).clamp_(min=0)
