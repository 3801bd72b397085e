"""Steps of the surface near a place, whose two sides the windows around it may see.

The edge of the upper side is the strongest texture around, and the search draws the disparities beside it up to its
own: what looks like the rim of an object may be what lies behind it. How far depends on how much texture that has.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from lsvision.image.stereo.agreement import fill_from_background

_STEP_PX = 1.0  # a smaller change of disparity within the reach is no step
# How far a step may reach, px, on its upper side where the residuals exceed the usual ones by so many times, and on its
# lower side where they exceed them at all.
_REACHES = ((1.5, 5), (6.0, 24))
_LOWER_PX = 2


def step_beside(
    disparity: Float[Tensor, "rows columns"], misfit: Float[Tensor, "rows columns"], block: int
) -> Float[Tensor, "rows columns"]:
    """Height, px of disparity, of the step that each block lies beside and does not fit well; 0 for none.

    A gap belongs to the surface behind it, so that the rim of an object beside what it hides is found, too. Of rows of
    blocks of two pixels every second one is looked at.

    Args:
        disparity: px, as the search found it, of each block of ``block`` pixels a side; NaN for none.
        misfit: variance of the residuals of each block's match over the usual one.
    """
    filled = fill_from_background(disparity[::block].contiguous())
    if filled is None:
        return torch.zeros_like(disparity)
    values, misfit_of = filled.numpy(), misfit[::block].numpy()
    height = -values - _least_around(-values, _LOWER_PX, block)
    height *= misfit_of > _REACHES[0][0]
    for least, reach_px in _REACHES:
        below = values - _least_around(values, reach_px, block)
        np.maximum(height, below, out=height, where=misfit_of > least)
    height *= height > _STEP_PX
    return torch.from_numpy(height).repeat_interleave(block, 0)[: len(disparity)]


def _least_around(values: NDArray[np.float32], reach_px: int, block: int) -> NDArray[np.float32]:
    """The least value up to a reach around each block, of rows that lie ``block**2`` pixels apart."""
    kernel = np.ones((2 * (reach_px // block**2) + 1, 2 * -(-reach_px // block) + 1), np.uint8)
    least: NDArray[np.float32] = cv2.erode(values, kernel)
    return least
