"""Samples that carry no measurement: saturated ones and those of faulty columns."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.stereo.windows import window_sum

_SLOPE_REACH = 1  # columns from a sample of the left image to those whose slope reads it
_CUBIC_REACH = 2  # columns from a position in the right image to the samples that its value is read from


@dataclass(frozen=True)
class UnusableSamples:
    """Which samples of a pair must not be matched; None where none of an image."""

    left: Bool[Tensor, "lines width"] | None
    right: Bool[Tensor, "lines width"] | None

    def on_lines(self, lines: Bool[Tensor, " lines"]) -> "UnusableSamples":
        """Those of some lines."""
        left, right = (None if image is None else image & lines[:, None] for image in (self.left, self.right))
        return UnusableSamples(left, right)

    def removed_from(self, disparity: Float[Tensor, "rows columns"], block: int) -> Float[Tensor, "rows columns"]:
        """Disparity without the blocks that a sample spoils, in the left image or at the partner in the right one.

        Refinement leaves blocks without a disparity out of all windows.

        Args:
            disparity: px, of each block of ``block`` pixels a side.
        """
        if self.left is not None:
            spoilt = _grown(_rows_of_blocks(self.left, block), _SLOPE_REACH)
            disparity = disparity.clone()
            for part in (spoilt[:, first::block] for first in range(block)):  # columns of the blocks
                disparity[:, : part.shape[1]].masked_fill_(part, torch.nan)
        if self.right is not None:
            spoilt = _grown(_rows_of_blocks(self.right, block), _CUBIC_REACH + block - 1)
            rows = spoilt.any(1).nonzero()[:, 0]
            part = disparity[rows]
            column = torch.arange(0, block * disparity.shape[1], block, dtype=disparity.dtype)
            partner = (column - torch.nan_to_num(part)).round_().clamp_(0, spoilt.shape[1] - 1).long()
            disparity = disparity.clone()
            disparity[rows] = part.masked_fill(spoilt[rows].gather(1, partner), torch.nan)
        return disparity


def holes_factor(
    searched: Float[Tensor, "rows columns"], kept: Float[Tensor, "rows columns"], size: int
) -> Float[Tensor, "rows columns"]:
    """By how many times the variance of a disparity grows where its window has lost blocks.

    The smaller the rest of a window, the less of the search's errors a step averages away.

    Args:
        searched, kept: disparity before and after blocks were removed.
        size: side of the windows, blocks.
    """
    lost = (kept.isnan() & ~searched.isnan()).float()
    share = window_sum(lost, size).div_(size**2).clamp_(max=0.9)
    return share.neg_().add_(1.0).pow_(-2)


def _rows_of_blocks(unusable: Bool[Tensor, "lines width"], block: int) -> NDArray[np.uint8]:
    """Which columns hold an unusable sample in any line of each row of blocks."""
    lines = unusable.numpy().view(np.uint8)
    if block == 1:
        return lines
    whole = cv2.copyMakeBorder(lines, 0, len(lines) % 2, 0, 0, cv2.BORDER_REPLICATE)
    return np.maximum(whole[::2], whole[1::2])


def _grown(marked: NDArray[np.uint8], reach: int) -> Bool[Tensor, "rows width"]:
    """Marked columns and those up to ``reach`` beside them."""
    return torch.from_numpy(cv2.dilate(marked, np.ones((1, 2 * reach + 1), np.uint8)).view(bool))
