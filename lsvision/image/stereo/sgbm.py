"""Dense stereo matching of rectified strips by semi-global matching."""

import math
from dataclasses import dataclass, replace

import cv2
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from lsvision.image.brightness import gray_bytes, white_level
from lsvision.types import TensorImage

_SUBPIXEL_STEPS = 16  # StereoSGBM returns sixteenths of a pixel
_COUNT_MULTIPLE = 16  # and searches ranges that are a multiple of sixteen


@dataclass(frozen=True)
class Search:
    """What semi-global matching searches for.

    Args:
        minimum_px, maximum_px: range of disparities, both included; it may be negative.
        block_size: side of the compared block, px, odd.
        small_change_penalty, large_change_penalty: P1 and P2, costs of a disparity change by one pixel and by more.
        left_right_check_px: largest disagreement of the two views' disparities.
        uniqueness_percent: by how much the best match must beat the second best.
        speckle_px: smaller patches are removed, px; 0 keeps all.
        beyond_px: disparities searched beyond either end of the range: what lies out there must not count as its end.

    Raises:
        ValueError: the range is empty.
    """

    minimum_px: int
    maximum_px: int
    block_size: int
    small_change_penalty: int
    large_change_penalty: int
    left_right_check_px: int
    uniqueness_percent: int
    speckle_px: int
    beyond_px: int = 1

    def __post_init__(self) -> None:
        if self.maximum_px <= self.minimum_px:
            raise ValueError(f"maximum_px must exceed minimum_px, got {self.minimum_px}..{self.maximum_px}")

    def matcher(self) -> cv2.StereoSGBM:
        """OpenCV's matcher; its range is extended to the multiple that it requires."""
        first, last = self.minimum_px - self.beyond_px, self.maximum_px + self.beyond_px
        count = last - first + 1
        return cv2.StereoSGBM.create(
            minDisparity=first,
            numDisparities=count + -count % _COUNT_MULTIPLE,
            blockSize=self.block_size,
            P1=self.small_change_penalty,
            P2=self.large_change_penalty,
            disp12MaxDiff=self.left_right_check_px,
            uniquenessRatio=self.uniqueness_percent,
            speckleWindowSize=self.speckle_px,
            speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def reduced(self, size: int) -> "Search":
        """The same range on images that are ``size`` times smaller."""
        return replace(
            self,
            minimum_px=math.floor(self.minimum_px / size),
            maximum_px=math.ceil(self.maximum_px / size),
            left_right_check_px=round(self.left_right_check_px / size),
        )

    def contains(self, disparity: Float[Tensor, "*shape"]) -> Tensor:
        """Which disparities lie within less than a pixel of the range; false for NaN."""
        return (disparity > self.minimum_px - 1) & (disparity < self.maximum_px + 1)


@dataclass(frozen=True)
class GrayPair:
    """Two images of the same size as bytes."""

    left: UInt8[Tensor, "lines width"]
    right: UInt8[Tensor, "lines width"]

    @classmethod
    def of(
        cls,
        left: Shaped[Tensor, "left_lines left_width left_channels"],
        right: Shaped[Tensor, "right_lines right_width right_channels"],
        white: float | None = None,
    ) -> "GrayPair":
        """Brightness of mono or RGB strips.

        Args:
            white: value that becomes 255; the pair's ``white_level`` where None.

        Raises:
            ValueError: shapes differ.
        """
        if left.shape != right.shape:
            raise ValueError(
                f"left and right strips must have one shape, got {tuple(left.shape)}, {tuple(right.shape)}"
            )
        white = white or white_level(TensorImage(left), TensorImage(right))
        return cls(gray_bytes(left, white), gray_bytes(right, white))


def match_sgbm(pair: GrayPair, search: Search) -> Float[Tensor, "lines width"]:
    """Disparity u_left - u_right of a pair, float32 px, by semi-global matching; NaN where there is no match.

    Source: Hirschmüller 2008, Stereo processing by semiglobal matching and mutual information; OpenCV's StereoSGBM.
    """
    # Columns closer to the image's edge than the range have no partner for some disparities, and SGBM leaves them out.
    # A margin that repeats the edge gives them one.
    matcher, width = search.matcher(), pair.left.shape[1]
    first = matcher.getMinDisparity()
    before = max(first + matcher.getNumDisparities(), 0)
    after = max(-first + 1, 0)
    padded = (
        cv2.copyMakeBorder(image.numpy(), 0, 0, before, after, cv2.BORDER_REPLICATE)
        for image in (pair.left, pair.right)
    )
    steps = torch.from_numpy(matcher.compute(*padded))[:, before : before + width]
    disparity = steps.to(torch.float32) / _SUBPIXEL_STEPS
    partner = torch.arange(width) - disparity
    has_partner = (partner >= 0) & (partner <= width - 1)
    return torch.where(search.contains(disparity) & has_partner, disparity, torch.nan)
