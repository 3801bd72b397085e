"""Steps of the surface: which side of one a place lies on, as far as its own grey values show it.

The windows of the search and of the refinement see both sides of a step. Where one side has more texture, places on the
other one are given its disparity, which fits well: what looks like the rim of an object may be what lies behind it. So
near a step each place must prove its side by small windows around it, every one of which must

- fit better by the disparity of the place than by that of the other side, and
- have more texture than its residuals: places that only one camera sees fit neither.

Steps that are as low as the slant of a surface may be over a gap count only where windows fit the other side better.

How often places of such windows turned out to be of the other side, on rendered scans, gives the chance that they are,
and with the height of the step the variance of their disparity. Where the window around a place fits the other side
alone, its disparity is wrong.
"""

import functools
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
from lsvision.image.stereo.differences import slope
from lsvision.image.stereo.warp import CubicLines
from lsvision.image.tiling import HaloRange, halo_ranges, in_parallel

_STEEPEST = 0.15  # a step is higher than a slope, px a px, over the reach
_ROOM_PX = 32  # beside the columns with a step
_TILE_LINES, _HALO_PX = 256, 24  # lines at once, to stay in the processor's cache, and what a place depends on
_BESIDE_PX = 32  # columns beside a place at the end of the scan that show what may lie beyond
_ROUND_PX = 3  # windows up to this distance around a place have to prove its side
# Of two windows that differ by noise alone, the residuals of one exceed those of the other by so many variances.
_VARIANCES, _TEXTURE = 4.0, 2.0  # and the squared slope that stands for a wrong match
# A place is on the other side, at least so many px away, where the window around it says so by its log-likelihood and
# fits there up to so many times the noise.
_REFUTED_STEP_PX, _REFUTED_WINDOW_PX, _REFUTED, _FITS = 1.5, 5, -6.0, 3.0
_LARGEST = 50.0  # log-likelihood of one pixel: one that is disturbed proves nothing about the others
_OTHER_SIDE = 0.08  # largest chance


@dataclass(frozen=True)
class _Zone:
    """Places up to ``reach_px`` from a step, ``step_px`` high, and the windows of ``window_px`` that prove their side.

    The chance of the other side falls from its largest as a logistic function of ``steepness (evidence - middle)``.
    """

    reach_px: int
    step_px: float
    window_px: int
    steepness: float
    middle: float

    @property
    def least_px(self) -> float:
        """Difference of disparities that means a step."""
        return self.step_px + _STEEPEST * self.reach_px

    def chance(self, evidence: list[NDArray[np.float32]], block: int) -> Tensor:
        """Chance that places lie on the other side, from log-likelihoods of single blocks that speak against it."""
        size = max(self.window_px // block, 1)
        summed = [cv2.boxFilter(values, -1, (size, size), normalize=False) for values in evidence]
        least = torch.from_numpy(cv2.erode(functools.reduce(np.minimum, summed), _square(_ROUND_PX, block)))
        return least.sub_(self.middle).mul_(-self.steepness).sigmoid_().mul_(_OTHER_SIDE)


_NEAR, _FAR = _Zone(5, 2.75, 3, 1.0, -0.5), _Zone(12, 2.75, 7, 2.0, 1.0)
_LOW = _Zone(5, 1.0, 3, 2.0, -2.5)  # noise alone hardly reaches this evidence


@dataclass(frozen=True)
class StepEvidence:
    """What the surroundings of steps say about disparities.

    Attributes:
        variance: by which the disparity of a place may be that of the other side, px²; 0 away from steps.
        refuted: whether the grey values around a place fit the other side, not its own.
    """

    variance: Float[Tensor, "rows columns"]
    refuted: Bool[Tensor, "rows columns"]


def step_evidence(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines width"],
    disparity: Float[Tensor, "rows columns"],
    noise_variance: Float[Tensor, "rows columns"],
    lowest_px: float,
) -> StepEvidence:
    """Whether disparities near a step may be, or are, those of the other side.

    A gap belongs to the surface behind it; one that reaches an end of its line may be as low as the range allows.

    Args:
        left, right: grey values of the pair.
        disparity: px, of each pixel or each block of 2 x 2 pixels, NaN for none.
        noise_variance: of the difference of two pixels that match, of each block.
        lowest_px: lowest disparity of the range.
    """
    block = block_side(left, disparity)
    found = StepEvidence(torch.zeros_like(disparity), torch.zeros_like(disparity, dtype=torch.bool))
    filled = fill_from_background(F.pad(disparity, (1, 1), value=lowest_px))
    assert filled is not None, "the two columns beside the map have values"
    surface = filled[:, 1:-1]

    def look(rows: HaloRange) -> None:
        """Look beside the steps of some rows of blocks."""
        lines, around = slice(block * rows.outer_start, block * rows.outer_stop), surface[rows.outer].contiguous()
        noise, inner = noise_variance[rows.outer], slice(rows.start, rows.stop)
        for columns in stretches(_columns_with_steps(around, block), _ROOM_PX // block):
            part, pixels = around[:, columns], slice(block * columns.start, block * columns.stop)
            match = _Match.of(left[lines, pixels], right[lines], part, noise[:, columns], pixels.start)
            for lower in (True, False):
                seen = match.against(_OtherSide.of(part.numpy(), block, lower=lower))
                found.variance[inner, columns] += seen.variance[rows.inner]
                found.refuted[inner, columns] |= seen.refuted[rows.inner]

    in_parallel(look, halo_ranges(len(surface), _TILE_LINES // block, _HALO_PX // block))
    return found


def _columns_with_steps(surface: Tensor, block: int) -> Bool[Tensor, " columns"]:
    """Columns with a step, or what may turn out to be none, in any row; every second row is looked at."""
    values, around = surface[::2].contiguous().numpy(), _square(_FAR.reach_px, block)[::2]
    lowest = _extreme(values, around, block, lower=True)
    return torch.from_numpy((cv2.dilate(values, around) - lowest > _LOW.least_px).any(0))


def _extreme(
    surface: NDArray[np.float32], around: NDArray[np.uint8], block: int, *, lower: bool
) -> NDArray[np.float32]:
    """Lowest or highest disparity around each place.

    Beyond the first and the last line the surface may be what it is beside a place on that line.
    """
    extreme, nearer = (cv2.erode, np.minimum) if lower else (cv2.dilate, np.maximum)
    found, rows = np.asarray(extreme(surface, around)), len(around) // 2
    beside = np.ones((1, around.shape[1] + 2 * (_BESIDE_PX // block)), np.uint8)
    for near_end, line in ((found[:rows], surface[:1]), (found[-rows:], surface[-1:])):
        nearer(near_end, extreme(line, beside), out=near_end)
    return found


@dataclass(frozen=True)
class _OtherSide:
    """Disparity of the other side of steps, px, their height, and places near, far, or near one of the ``low`` ones."""

    disparity: NDArray[np.float32]
    height: NDArray[np.float32]
    near: NDArray[np.bool_]
    far: NDArray[np.bool_]
    low: NDArray[np.bool_]

    @classmethod
    def of(cls, surface: NDArray[np.float32], block: int, *, lower: bool) -> "_OtherSide":
        """The lower sides of a surface, or its upper ones."""
        sign = 1.0 if lower else -1.0
        far, near = (_extreme(surface, _square(zone.reach_px, block), block, lower=lower) for zone in (_FAR, _NEAR))
        height = sign * (surface - near)
        is_near = height > _NEAR.least_px
        is_far = (sign * (surface - far) > _FAR.least_px) & ~is_near
        is_low = (height > _LOW.least_px) & ~is_near & ~is_far
        other = np.where(is_near | is_low, near, far)
        return cls(other, sign * (surface - other), is_near, is_far, is_low)


@dataclass(frozen=True)
class _Match:
    """A part of a pair: residuals of its disparities, and of a wrong match, squared and in units of log-likelihood.

    Attributes:
        left: grey values, float32, from ``first_column`` of the right image on.
        noise: variance of the difference of two pixels that match.
        unit: variance of the grey values of a block that changes its log-likelihood by one.
    """

    left: Tensor
    right: CubicLines
    first_column: int
    noise: Tensor
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
        left, cubic = whole_blocks(left, rows, block), CubicLines.of(whole_blocks(right, rows, block))
        first_column -= first
        unit = noise_variance.mul(_VARIANCES / block**2)
        own = _squared_residual(left, cubic, surface, first_column)
        wrong = _by_block(slope(left).square_(), surface).mul_(_TEXTURE)
        return cls(left, cubic, first_column, noise_variance, unit, own, wrong)

    def against(self, side: _OtherSide) -> StepEvidence:
        """How the disparities compare with those of the other side."""
        squared = _squared_residual(self.left, self.right, torch.from_numpy(side.disparity), self.first_column)
        other, wrong = (self._log_likelihood(values) for values in (squared, self.wrong))
        block = block_side(self.left, self.own)
        beside = np.where(side.near | side.far | side.low, other, np.float32(0.0))
        chance, both = torch.zeros_like(squared), [beside, wrong]
        for zone, where, evidence in ((_NEAR, side.near, both), (_FAR, side.far, both), (_LOW, side.low, [beside])):
            if where.any():
                chance.addcmul_(zone.chance(evidence, block), torch.from_numpy(where))
        refuted = self._refuted(squared, other) & (side.height > _REFUTED_STEP_PX)
        return StepEvidence(chance * torch.from_numpy(side.height).square(), torch.from_numpy(refuted))

    def _refuted(self, squared: Tensor, other: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Where the other side fits as well as noise allows, and much better, from its residuals."""
        size = (max(_REFUTED_WINDOW_PX // block_side(self.left, self.own), 1),) * 2
        fits = cv2.blur(squared.numpy(), size) < self.noise.mul(_FITS).numpy()
        return (cv2.boxFilter(other, -1, size, normalize=False) < _REFUTED) & fits

    def _log_likelihood(self, squared: Tensor) -> NDArray[np.float32]:
        """That of the disparities over that of others, whose residuals are given."""
        return squared.sub(self.own).div_(self.unit).clamp_(-_LARGEST, _LARGEST).numpy()


def _squared_residual(left: Tensor, right: CubicLines, disparity: Tensor, first_column: int) -> Tensor:
    """Mean squared difference of the pixels of each block."""
    whole = repeated(disparity.contiguous(), block_side(left, disparity))
    return _by_block((left - right.at(whole, first_column)).square_(), disparity)


def _by_block(values: Tensor, like: Tensor) -> Tensor:
    """The mean over each block of a map with a value for each pixel."""
    if values.shape == like.shape:
        return values
    return torch.from_numpy(cv2.resize(values.numpy(), like.shape[::-1], interpolation=cv2.INTER_AREA))


def _square(reach_px: int, block: int) -> NDArray[np.uint8]:
    """Blocks up to a reach around one."""
    return np.ones((2 * -(-reach_px // block) + 1,) * 2, np.uint8)
