"""Dense stereo matching of rectified strips by semi-global matching."""

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.brightness import gray_bytes, white_level
from lsvision.types import TensorImage

_SUBPIXEL_STEPS = 16  # StereoSGBM returns sixteenths of a pixel
_NUM_MULTIPLE = 16  # and searches ranges that are a multiple of sixteen


def match_sgbm(
    left: Tensor,
    right: Tensor,
    *,
    minimum_px: int,
    maximum_px: int,
    block_size: int,
    lambda1: float,
    lambda2: float,
    left_right_check_px: int,
    uniqueness_percent: int,
    speckle_px: int,
    white: float | None = None,
) -> Float[Tensor, "lines width"]:
    """Disparity u_left - u_right of a pair of strips; float32 px, NaN where there is no match.

    Args:
        left, right: ``(lines, width, channels)`` of the same shape.
        minimum_px, maximum_px: range searched, both included; it may be negative.
        lambda1, lambda2: penalty of a disparity change by one and by more, per pixel of the block.
        left_right_check_px: largest disagreement of the two views' disparities.
        white: value that is matched as 255, the brightest of a byte; the pair's ``white_level`` where None.

    Raises:
        ValueError: shapes differ or the range is empty.

    Source: Hirschmüller 2008, Stereo processing by semiglobal matching and mutual information; OpenCV's StereoSGBM.
    """
    check_pair(left, right, minimum_px, maximum_px)
    white = white or white_level(TensorImage(left), TensorImage(right))
    pair = gray_bytes(left, white), gray_bytes(right, white)
    penalties = round(lambda1 * block_size**2), round(lambda2 * block_size**2)
    matcher = sgbm_matcher(
        (minimum_px, maximum_px), block_size, penalties, left_right_check_px, uniqueness_percent, speckle_px
    )
    return run_sgbm(matcher, *pair, maximum_px)


def check_pair(left: Tensor, right: Tensor, minimum_px: int, maximum_px: int) -> None:
    """Raise ValueError where two strips or a range cannot be matched."""
    if left.shape != right.shape:
        raise ValueError(f"left and right strips must have one shape, got {tuple(left.shape)}, {tuple(right.shape)}")
    if maximum_px <= minimum_px:
        raise ValueError(f"maximum_px must exceed minimum_px, got {minimum_px}..{maximum_px}")


def sgbm_matcher(
    range_px: tuple[int, int],
    block_size: int,
    penalties: tuple[int, int],
    left_right_check_px: int,
    uniqueness_percent: int,
    speckle_px: int,
) -> cv2.StereoSGBM:
    """OpenCV's matcher over a range of disparities, both ends included, made up to the multiple it asks for."""
    count = range_px[1] - range_px[0] + 1
    return cv2.StereoSGBM.create(
        minDisparity=range_px[0],
        numDisparities=count + -count % _NUM_MULTIPLE,
        blockSize=block_size,
        P1=penalties[0],
        P2=penalties[1],
        disp12MaxDiff=left_right_check_px,
        uniquenessRatio=uniqueness_percent,
        speckleWindowSize=speckle_px,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def run_sgbm(matcher: cv2.StereoSGBM, left: Tensor, right: Tensor, maximum_px: int) -> Float[Tensor, "lines width"]:
    """Disparity of two grey images, uint8 ``(lines, width)``, over their whole width; NaN where there is no match."""
    # Columns within the range of the image's edge have no partner for some disparities and SGBM leaves them out:
    # a margin of the edge's own value gives them one.
    minimum_px, width = matcher.getMinDisparity(), left.shape[1]
    before, after = max(minimum_px + matcher.getNumDisparities(), 0), max(-minimum_px + 1, 0)
    padded = (cv2.copyMakeBorder(image.numpy(), 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right))
    steps = torch.from_numpy(matcher.compute(*padded))[:, before : before + width]
    disparity = steps.to(torch.float32) / _SUBPIXEL_STEPS
    partner = torch.arange(width) - disparity
    in_range = (disparity > minimum_px - 1) & (disparity < maximum_px + 1)
    seen = in_range & (partner >= 0) & (partner <= width - 1)
    return torch.where(seen, disparity, torch.nan)
