"""How much brighter or darker the right image of a pair is than the left one, column by column.

Two cameras differ by exposure, gain, black level and tone curve, and each darkens towards the ends of its lines. None
of it changes from line to line, and along a line only the gain does. So the left value of a matched pixel is taken for

    gain(u) (right + curve right² / 255) + offset

with a gain that is linear between a few columns u of the right image: light is lost before the tone curve. The fit, by
Gauss-Newton steps, is robust: where a camera sees a gloss
that the other does not, or a match is wrong, pixels lose their weight.
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
    hats = _between(position)
    steps = _ALIKE**0.5 * torch.eye(_NODES, _NODES + 2, dtype=torch.float64).diff(dim=0)
    gain, offset, curve = _first_gain(left, right, position), 0.0, 0.0
    for number in range(_ROUNDS):
        straight, factor = right + curve * right.square(), hats @ gain
        change = factor * straight + offset - right
        residual = target - change
        spread = (residual.abs().median() / 0.6745).clamp(min=_LEAST_SPREAD / 255.0)
        outlier = spread * max(_OUTLIER, _FIRST_OUTLIER * _NARROWER**number)
        weight = (1 - (residual / outlier).square()).clamp(min=0).square()
        design = torch.stack([torch.ones_like(right), factor * right.square()], 1)
        design = torch.cat([hats * straight[:, None], design], 1)
        normal = design.mT @ (weight[:, None] * design) + steps.mT @ steps
        pull = design.mT @ (weight * residual) - steps.mT @ (steps[:, :_NODES] @ gain)
        step = torch.linalg.lstsq(normal, pull).solution
        gain, offset, curve = gain + step[:_NODES], offset + float(step[_NODES]), curve + float(step[_NODES + 1])
    if _rms(change) <= _EQUAL:
        return None
    return Exposure(gain, 255.0 * offset, curve)


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
