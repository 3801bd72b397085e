"""Gloss: light that both cameras see at places of its own, and the detail by which a surface differs from it.

The mirror image of a lamp lies behind the surface, or in front of a hollow one. On a surface without texture of its own
its border is all that there is to match, and both cameras agree on the depth of the lamp's image. No test of a match
by itself can find that out. But light changes gradually, from column to column and still less from line to line, while
a surface has grain, scratches and edges. So where light is suspect, ``light_is_suspect``, a match must be proven by
details that light does not have, ``proven_by_detail``.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lsvision.image.stereo.blocks import block_side, enlarged, repeated, whole_blocks
from lsvision.image.stereo.clipping import UnusableSamples
from lsvision.image.stereo.differences import second_difference, slope
from lsvision.image.stereo.warp import warp_cubic
from lsvision.image.stereo.windows import Windows
from lsvision.image.tiling import HaloRange, halo_ranges, in_parallel

_PATCH, _PATCH_SHARE = 5, 0.7  # px; unusable samples this dense are a saturated area, others are noise near white
_SATURATED_SHARE = 0.002  # of the pixels of an image
_SAMPLED, _MEAN_PX = 32, 9  # every so many lines are compared, by means over so many columns
# Difference of grey values, of 255, and the share of the matched pixels: photographs of boards reach 0.18.
_OTHER_LIGHT, _OTHER_SHARE = 8.0, 0.25
_NOISES = 4.0  # standard deviations of a mean over as many columns
_TILE_LINES = 256  # stay in the processor's cache
_APART = 4  # lines over which details along the scan are differences
# Variance of a detail of white noise, over that of the noise, and of its residual: interpolation has smoothed the
# right image to 0.6 of its noise on average.
_OF_VALUES, _OF_SLOPES, _OF_CURVATURE, RESIDUAL_NOISE = 2.0, 1.0, 6.0, 1.6
_EXPLAINED = 0.5  # share of a detail that its match must explain
# What a detail must have beyond noise: so many times its noise, and as large a part of the squared slopes.
_ALONG_NOISE, _ALONG_SLOPE = 0.5, 0.6
_SHARP_NOISE, _SHARP_SLOPE = 1.0, 0.5
_LIKE_SHIFT = 0.6  # correlation of the texture's slopes with the column that covers the errors of rendered rails


def light_is_suspect(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines right_width"],
    disparity: Float[Tensor, "rows columns"],
    unusable: UnusableSamples,
    noise_variance: float,
) -> bool:
    """Whether both images have saturated areas, or many places differ in brightness between the cameras.

    Elsewhere no proof is asked for: it would drop a twentieth of the right pixels of photographs. So a gloss that is
    below saturation, on a surface without texture, may still count.

    Args:
        left, right: grey values of 255, the right ones as bright as the left ones.
        disparity: px, of each pixel or each block of 2 x 2 pixels, NaN for none.
        noise_variance: of the difference of two pixels that match.
    """
    saturated = all(_saturated_share(samples) > _SATURATED_SHARE for samples in (unusable.left, unusable.right))
    return saturated or _differing_share(left, right, disparity, noise_variance) > _OTHER_SHARE


def _saturated_share(unusable: Bool[Tensor, "lines width"] | None) -> float:
    """Share of the pixels that lie in saturated areas."""
    if unusable is None or np.count_nonzero(unusable.numpy()) <= _SATURATED_SHARE * unusable.numel():
        return 0.0  # without a look at where they are
    density = cv2.blur(unusable.to(torch.uint8).mul_(255).numpy(), (_PATCH, _PATCH))
    return float((density > 255 * _PATCH_SHARE).mean())


def _differing_share(left: Tensor, right: Tensor, disparity: Tensor, noise_variance: float) -> float:
    """Share of the matched pixels of some lines that are brighter or darker than their partners."""
    block = block_side(left, disparity)
    sampled = repeated(disparity[:: _SAMPLED // block], block)[::block, : left.shape[1]]
    matched = sampled == sampled
    left, right = (image[::_SAMPLED].to(torch.float32) for image in (left, right))
    difference = (left - warp_cubic(right, torch.nan_to_num(sampled))).mul_(matched)
    count, total = (
        cv2.boxFilter(values.numpy(), -1, (_MEAN_PX, 1), normalize=False)
        for values in (matched.to(torch.float32), difference)
    )
    limit = _OTHER_LIGHT + _NOISES * (noise_variance / _MEAN_PX) ** 0.5
    differing = (abs(total) > limit * count) & matched.numpy()
    return float(differing.sum()) / max(int(matched.sum()), 1)


@dataclass(frozen=True)
class DetailProof:
    """What details of the surface say about a match in suspect light.

    Attributes:
        proven: whether windows show such details, and the match explains most of them.
        variance: of the disparity by the light that changes along the line within a window, px².
    """

    proven: Bool[Tensor, "rows columns"]
    variance: Float[Tensor, "rows columns"]


def proven_by_detail(
    left: Shaped[Tensor, "lines width"],
    right: Shaped[Tensor, "lines right_width"],
    disparity: Float[Tensor, "rows columns"],
    noise_variance: Float[Tensor, "rows columns"],
    window: int,
) -> DetailProof:
    """Where windows show details of the surface that the match explains, and what light adds to its variance.

    Either the slopes of the grey values change along the scan, over four lines, or they change sharply along the line,
    from one pixel to the next. Both must be more than noise and, light has slopes, a good part of the squared slopes.

    Args:
        left, right: grey values.
        disparity: px, of each pixel or each block of 2 x 2 pixels, NaN for none.
        noise_variance: of the grey values of one image, of each block.
        window: side of the windows, blocks.
    """
    block = block_side(left, disparity)
    proof = DetailProof(torch.zeros_like(disparity, dtype=torch.bool), torch.zeros_like(disparity))

    def prove(rows: HaloRange) -> None:
        """Prove some rows of blocks."""
        images = [whole_blocks(image, rows.outer, block) for image in (left, right)]
        part = _Detail.of(images[0], images[1], disparity[rows.outer], window).proof(noise_variance[rows.outer])
        proof.proven[rows.start : rows.stop] = part.proven[rows.inner]
        proof.variance[rows.start : rows.stop] = part.variance[rows.inner]

    halo = window // 2 + _APART // block
    in_parallel(prove, halo_ranges(disparity.shape[0], _TILE_LINES // block, halo))
    return proof


@dataclass(frozen=True)
class _Detail:
    """Grey values of a left image, their residuals after the match, and windows of matched blocks."""

    left: Tensor
    residual: Tensor
    matched: Bool[Tensor, "rows columns"]
    window: int

    @classmethod
    def of(cls, left: Tensor, right: Tensor, disparity: Tensor, window: int) -> "_Detail":
        """Those of some rows of blocks."""
        block = block_side(left, disparity)
        warped = warp_cubic(right, enlarged(torch.nan_to_num(disparity), block))
        return cls(left, left - warped, disparity == disparity, window)

    def proof(self, noise: Tensor) -> DetailProof:
        """What windows prove, from the variance of the noise of an image."""
        block = block_side(self.left, self.matched)
        left, residual = slope(self.left), slope(self.residual)
        reach = _APART // 2 // block
        along, across, both = self._windows(reach, 0), self._windows(0, 1), self._windows(reach, 1)
        mean = across.mean(left)
        texture = across.covariance(left, left, mean, mean).sub_(noise, alpha=0.5)
        values = _Energy.of(along, _along(self.left), _along(self.residual), noise * _OF_VALUES)
        slopes = _Energy.of(both, _along(left), _along(residual), noise * _OF_SLOPES)
        sharp = _Energy.of(
            across, second_difference(self.left), second_difference(self.residual), noise * _OF_CURVATURE
        )
        changing = slopes.exceeds(_ALONG_NOISE, _ALONG_SLOPE * texture) & slopes.is_explained()
        edges = sharp.exceeds(_SHARP_NOISE, _SHARP_SLOPE * texture) & sharp.is_explained()
        proven = (changing | edges) & values.is_explained(least=2.0 * values.noise)
        return DetailProof(proven, self._light_variance(texture, noise))

    def _light_variance(self, texture: Tensor, noise: Tensor) -> Tensor:
        """Variance of the disparity, px², by the slope of the light: least squares take it for a shift of texture."""
        windows, reach, block = self._windows(0, 0), self.window // 2, block_side(self.left, self.matched)
        mean = windows.mean(self.residual)
        apart = 2 * reach * block
        across = F.pad(mean[:, 2 * reach :] - mean[:, : -2 * reach], (reach, reach)).div_(apart)
        own = noise * (2 * RESIDUAL_NOISE / (self.window * block * apart) ** 2)
        light = across.square_().sub_(own).clamp_(min=0)
        spread = ((self.window * block) ** 2 - 1) / 12.0  # variance of the columns of a window
        return light.mul_(_LIKE_SHIFT**2 * spread).div_(torch.maximum(texture, noise))

    def _windows(self, rows: int, columns: int) -> Windows:
        """Windows of the blocks that match and whose neighbours at a distance do."""
        matched = self.matched.to(torch.float32)
        if rows:
            matched = F.pad(matched[2 * rows :] * matched[: -2 * rows], (0, 0, rows, rows))
        if columns:
            matched = F.pad(matched[:, 2 * columns :] * matched[:, : -2 * columns], (columns, columns)) * matched
        return Windows.over(matched > 0, self.window)


@dataclass(frozen=True)
class _Energy:
    """Mean squares of a detail over windows, beyond noise, and those of what the match leaves of it."""

    left: Tensor
    residual: Tensor
    noise: Tensor

    @classmethod
    def of(cls, windows: Windows, left: Tensor, residual: Tensor, noise: Tensor) -> "_Energy":
        """Those of the detail of an image and of the residuals, whose noise has some variance in the image."""
        own = windows.mean(left.square()).sub_(noise)
        return cls(own, windows.mean(residual.square()).sub_(noise, alpha=RESIDUAL_NOISE), noise)

    def exceeds(self, factor: float, least: Tensor) -> Tensor:
        """Whether there is more of it than so many times the noise and than some energy."""
        return self.left > torch.maximum(factor * self.noise, least)

    def is_explained(self, least: Tensor | None = None) -> Tensor:
        """Whether the match explains most of it; of less than ``least`` it need not explain more."""
        own = self.left if least is None else torch.maximum(self.left, least)
        return self.residual < _EXPLAINED * own


def _along(image: Tensor) -> Tensor:
    """Differences of lines that are four apart."""
    return F.pad(image[_APART:] - image[:-_APART], (0, 0, _APART // 2, _APART // 2))
