"""Steps of the surface: which side of one a place lies on, as far as its own grey values show it.

The windows of the search and of the refinement see both sides of a step. Where one side has more texture, places on the
other one are given its disparity, which fits well: what looks like the rim of an object may be what lies behind it. So
near a step each place must prove its side by small windows around it, every one of which must

- fit better by the disparity of the place than by that of the other side, and
- have more texture than its residuals: places that only one camera sees fit neither.

How often places of such windows turned out to be of the other side, on rendered scans, gives the chance that they are,
and with the height of the step the variance of their disparity.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Shaped
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.stereo.agreement import fill_from_background
from lsvision.image.stereo.best_match import stretches
from lsvision.image.stereo.blocks import block_side, repeated, whole_blocks
from lsvision.image.stereo.warp import warp_cubic

_STEP_PX, _STEEPEST = 2.75, 0.15  # a step is higher than this and than a slope, px a px, over the reach
_ROOM_PX = 32  # beside the columns with a step
_ROUND_PX = 3  # windows up to this distance around a place have to prove its side
# Of two windows that differ by noise alone, the residuals of one exceed those of the other by so many variances.
_VARIANCES, _TEXTURE = 4.0, 2.0  # and the squared slope that stands for a wrong match
_LARGEST = 50.0  # log-likelihood of one pixel: one that is disturbed proves nothing about the others
_OTHER_SIDE = 0.08  # largest chance


@dataclass(frozen=True)
class _Zone:
    """Places up to ``reach_px`` from a step, and the windows of ``window_px`` that prove their side.

    The chance of the other side falls from its largest as a logistic function of ``steepness (evidence - middle)``.
    """

    reach_px: int
    window_px: int
    steepness: float
    middle: float

    @property
    def least_px(self) -> float:
        """Height of the lowest step."""
        return _STEP_PX + _STEEPEST * self.reach_px

    def chance(self, evidence: list[NDArray[np.float32]], block: int) -> Tensor:
        """Chance that places lie on the other side, from log-likelihoods of single blocks that speak against it."""
        size = max(self.window_px // block, 1)
        summed = [cv2.boxFilter(values, -1, (size, size), normalize=False) for values in evidence]
        least = torch.from_numpy(cv2.erode(np.minimum(*summed), _square(_ROUND_PX, block)))
        return least.sub_(self.middle).mul_(-self.steepness).sigmoid_().mul_(_OTHER_SIDE)


_NEAR, _FAR = _Zone(5, 3, 1.0, -0.5), _Zone(12, 7, 2.0, 1.0)


def other_side_variance(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines width"],
    disparity: Float[Tensor, "rows columns"],
    noise_variance: Float[Tensor, "rows columns"],
    lowest_px: float,
) -> Float[Tensor, "rows columns"]:
    """Variance, px², by which the disparity of a place near a step may be that of the other side; 0 elsewhere.

    A gap belongs to the surface behind it; one that reaches an end of its line may be as low as the range allows.

    Args:
        left, right: grey values of the pair.
        disparity: px, of each pixel or each block of 2 x 2 pixels, NaN for none.
        noise_variance: of the difference of two pixels that match, of each block.
        lowest_px: lowest disparity of the range.
    """
    variance, block = torch.zeros_like(disparity), block_side(left, disparity)
    filled = fill_from_background(F.pad(disparity, (1, 1), value=lowest_px))
    assert filled is not None, "the two columns beside the map have values"
    surface = filled[:, 1:-1].contiguous()
    for columns in stretches(_columns_with_steps(surface, block), _ROOM_PX // block):
        part, pixels = surface[:, columns], slice(block * columns.start, block * columns.stop)
        sides = [_OtherSide.of(part.numpy(), block, lower=lower) for lower in (True, False)]
        match = _Match.of(left[:, pixels], right, part, noise_variance[:, columns], pixels.start)
        for side in sides:
            variance[:, columns] += match.variance(side)
    return variance


def _columns_with_steps(surface: Tensor, block: int) -> Bool[Tensor, " columns"]:
    """Columns with a step, or what may turn out to be none, in any row; every second row is looked at."""
    values, around = surface[::2].contiguous().numpy(), _square(_FAR.reach_px, block)[::2]
    height = np.subtract(cv2.dilate(values, around), cv2.erode(values, around))
    return torch.from_numpy((height > _NEAR.least_px).any(0))


@dataclass(frozen=True)
class _OtherSide:
    """Disparity of the other side of steps, px, the height of the step, 0 for none, and which places are near it."""

    disparity: NDArray[np.float32]
    height: NDArray[np.float32]
    near: NDArray[np.bool_]

    @classmethod
    def of(cls, surface: NDArray[np.float32], block: int, *, lower: bool) -> "_OtherSide":
        """The lower sides of a surface, or its upper ones."""
        extreme, sign = (cv2.erode, 1.0) if lower else (cv2.dilate, -1.0)
        far, near = (np.asarray(extreme(surface, _square(zone.reach_px, block))) for zone in (_FAR, _NEAR))
        is_near = sign * (surface - near) > _NEAR.least_px
        is_far = sign * (surface - far) > _FAR.least_px
        other = np.where(is_near, near, np.where(is_far, far, surface))
        return cls(other, sign * (surface - other), is_near)


@dataclass(frozen=True)
class _Match:
    """A part of a pair: residuals of its disparities, and of a wrong match, squared and in units of log-likelihood.

    Attributes:
        left: grey values, float32, from ``first_column`` of the right image on.
        unit: variance of the grey values of a block that changes its log-likelihood by one.
    """

    left: Tensor
    right: Tensor
    first_column: int
    unit: Tensor
    own: Tensor
    wrong: Tensor

    @classmethod
    def of(cls, left: Tensor, right: Tensor, surface: Tensor, noise_variance: Tensor, first_column: int) -> "_Match":
        """Those of the disparities of a surface, px."""
        block, rows = block_side(left, surface), slice(0, len(surface))
        # The part of the right image that any disparity within the reach of the surface may need.
        low, high = (int(value) for value in torch.aminmax(surface))
        first = max(min(first_column - high, right.shape[1]) - _ROOM_PX, 0)
        right = right[:, first : max(first_column + left.shape[1] - low, first) + _ROOM_PX]
        left, right = (whole_blocks(image, rows, block) for image in (left, right))
        first_column -= first
        slope = F.pad(left[:, 2:] - left[:, :-2], (1, 1)).mul_(0.5)
        unit = noise_variance.mul(_VARIANCES / block**2)
        own = _squared_residual(left, right, surface, first_column)
        return cls(left, right, first_column, unit, own, _by_block(slope.square_(), surface).mul_(_TEXTURE))

    def variance(self, side: _OtherSide) -> Tensor:
        """Variance, px², by which the disparities may be those of the other side."""
        other = _squared_residual(self.left, self.right, torch.from_numpy(side.disparity), self.first_column)
        evidence = [
            (squared - self.own).div_(self.unit).clamp_(-_LARGEST, _LARGEST).numpy() for squared in (other, self.wrong)
        ]
        block = block_side(self.left, self.own)
        near, far = (zone.chance(evidence, block) for zone in (_NEAR, _FAR))
        chance = torch.where(torch.from_numpy(side.near), near, far)
        return chance.mul_(torch.from_numpy(side.height).square())


def _squared_residual(left: Tensor, right: Tensor, disparity: Tensor, first_column: int) -> Tensor:
    """Mean squared difference of the pixels of each block."""
    whole = repeated(disparity.contiguous(), block_side(left, disparity))
    return _by_block((left - warp_cubic(right, whole, first_column)).square_(), disparity)


def _by_block(values: Tensor, like: Tensor) -> Tensor:
    """The mean over each block of a map with a value for each pixel."""
    if values.shape == like.shape:
        return values
    return torch.from_numpy(cv2.resize(values.numpy(), like.shape[::-1], interpolation=cv2.INTER_AREA))


def _square(reach_px: int, block: int) -> NDArray[np.uint8]:
    """Blocks up to a reach around one."""
    return np.ones((2 * -(-reach_px // block) + 1,) * 2, np.uint8)
