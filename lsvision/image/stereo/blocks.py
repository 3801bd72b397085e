"""Maps with a value for each pixel of an image or for each block of 2 x 2 pixels, the last ones perhaps incomplete."""

import cv2
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.image.tiling import halo_ranges

_ROWS_AT_ONCE = 32  # stay in the processor's cache, which halves the time
_LARGEST_STEP_PX = 4.0  # an interpolated value that differs by more from that of its block mixes two surfaces


def block_side(image: Shaped[Tensor, "lines width"], values: Shaped[Tensor, "rows columns"]) -> int:
    """Pixels along the side of a block, 1 or 2, from the shapes of an image and of the values of its blocks.

    Raises:
        ValueError: the map has neither a value for each pixel nor one for each block.
    """
    for block in (1, 2):
        if tuple(values.shape) == tuple(-(-size // block) for size in image.shape):
            return block
    raise ValueError(
        f"disparity must have a value for each pixel or each 2 x 2 pixels of images {tuple(image.shape)}, "
        f"got {tuple(values.shape)}"
    )


def whole_blocks(image: Shaped[Tensor, "lines width"], rows: slice, block: int) -> Float[Tensor, "block_lines columns"]:
    """Grey values of some rows of blocks as float32; the edge is repeated where the last blocks are incomplete."""
    values = image[block * rows.start : block * rows.stop].to(torch.float32)
    bottom, right = block * (rows.stop - rows.start) - values.shape[0], -values.shape[1] % block
    if bottom or right:
        values = torch.from_numpy(cv2.copyMakeBorder(values.numpy(), 0, bottom, 0, right, cv2.BORDER_REPLICATE))
    return values


def repeated(values: Float[Tensor, "rows columns"], block: int) -> Float[Tensor, "lines width"]:
    """The value of its block for each pixel."""
    if block == 1:
        return values
    size = block * values.shape[1], block * values.shape[0]
    return torch.from_numpy(cv2.resize(values.numpy(), size, interpolation=cv2.INTER_NEAREST))


def enlarged(
    disparity: Float[Tensor, "rows columns"], block: int, largest_step_px: float = _LARGEST_STEP_PX
) -> Float[Tensor, "lines width"]:
    """Disparity of each pixel, interpolated between blocks of one surface; beside an edge or a gap that of its block.

    Args:
        largest_step_px: largest difference between an interpolated value and that of its block.
    """
    if block == 1:
        return disparity
    result = disparity.new_empty(block * disparity.shape[0], block * disparity.shape[1])
    values, pixels = disparity.numpy(), result.numpy()
    # OpenCV's compare and masked copy take half the time of torch's.
    for rows in halo_ranges(disparity.shape[0], _ROWS_AT_ONCE, 1):
        part, own = values[rows.outer], pixels[block * rows.start : block * rows.stop]
        size = block * part.shape[1], block * part.shape[0]
        inner = slice(block * rows.inner.start, block * rows.inner.stop)
        smooth = cv2.resize(part, size, interpolation=cv2.INTER_LINEAR)[inner]
        cv2.resize(part[rows.inner], own.shape[::-1], dst=own, interpolation=cv2.INTER_NEAREST)
        close = cv2.compare(cv2.absdiff(smooth, own), largest_step_px, cv2.CMP_LT)  # not where it is NaN
        cv2.copyTo(smooth, close, own)
    return result
