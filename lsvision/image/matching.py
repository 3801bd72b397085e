"""Dense stereo matching of rectified strips by semi-global matching."""

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.checkerboard import gray

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
) -> Float[Tensor, "lines width"]:
    """Disparity u_left - u_right of a pair of strips; float32 px, NaN where there is no match.

    Args:
        left, right: ``(lines, width, channels)`` of the same shape; 16-bit values are matched on their upper eight bits
            of the strip's range.
        minimum_px, maximum_px: range searched, both included; it may be negative.
        lambda1, lambda2: penalty of a disparity change by one and by more, per pixel of the block.
        left_right_check_px: largest disagreement of the two views' disparities.

    Raises:
        ValueError: shapes differ or the range is empty.

    Source: Hirschmüller 2008, Stereo processing by semiglobal matching and mutual information; OpenCV's StereoSGBM.
    """
    if left.shape != right.shape:
        raise ValueError(f"left and right strips must have one shape, got {tuple(left.shape)}, {tuple(right.shape)}")
    if maximum_px <= minimum_px:
        raise ValueError(f"maximum_px must exceed minimum_px, got {minimum_px}..{maximum_px}")
    count = maximum_px - minimum_px + 1
    count += -count % _NUM_MULTIPLE
    matcher = cv2.StereoSGBM.create(
        minDisparity=minimum_px,
        numDisparities=count,
        blockSize=block_size,
        P1=round(lambda1 * block_size**2),
        P2=round(lambda2 * block_size**2),
        disp12MaxDiff=left_right_check_px,
        uniquenessRatio=uniqueness_percent,
        speckleWindowSize=speckle_px,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # Columns within the range of the image's edge have no partner for some disparities and SGBM leaves them out:
    # a margin of the edge's own value gives them one.
    before, after = max(minimum_px + count, 0), max(-minimum_px + 1, 0)
    pair = [_padded(_bytes(image), before, after) for image in (left, right)]
    steps = torch.from_numpy(matcher.compute(pair[0].numpy(), pair[1].numpy()))[:, before : before + left.shape[1]]
    disparity = steps.to(torch.float32) / _SUBPIXEL_STEPS
    partner = torch.arange(left.shape[1]) - disparity
    in_range = (disparity > minimum_px - 1) & (disparity < maximum_px + 1)
    seen = in_range & (partner >= 0) & (partner <= left.shape[1] - 1)
    return torch.where(seen, disparity, torch.nan)


def _bytes(image: Tensor) -> Tensor:
    values = gray(image)
    if image.dtype == torch.uint8:
        return values.round().to(torch.uint8)
    low, high = torch.aminmax(values)
    return ((values - low) * (255.0 / max(float(high - low), 1.0))).to(torch.uint8)


def _padded(image: Tensor, before: int, after: int) -> Tensor:
    return torch.nn.functional.pad(image[None].to(torch.float32), (before, after), mode="replicate")[0].to(torch.uint8)
