"""Options of the matching."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from lsvision.schema import (
    Checked,
    Interval,
    NonNegative,
    NonNegativeInt,
    OddInt,
    OddIntFrom3,
    Percent,
    Positive,
    PositiveInt,
    PositiveOrInfinite,
)

Matcher = Literal["auto", "sgbm", "coarse_to_fine"]

COARSE_TO_FINE_PX = 1500  # from this width on a quarter of the size is enough to search in


@dataclass(frozen=True)
class Variant:
    """The values that a matcher gives to options that are None."""

    refine_iterations: int
    largest_sigma_px: float
    halo_lines: int


VARIANTS: dict[Matcher, Variant] = {
    # Of narrow lines. There 0.2 px drops more right pixels of photographs than OpenCV misses.
    "auto": Variant(refine_iterations=2, largest_sigma_px=0.22, halo_lines=48),
    "sgbm": Variant(refine_iterations=2, largest_sigma_px=math.inf, halo_lines=24),
    # The search has refined once already, at half the size.
    "coarse_to_fine": Variant(refine_iterations=1, largest_sigma_px=0.2, halo_lines=48),
}


@dataclass(frozen=True)
class DisparityConfig(Checked):
    """How two images are matched.

    ``matcher`` is ``sgbm``, one pass over the whole range as in the paper, ``coarse_to_fine``, the whole range at a
    quarter of the size and a few disparities at half of it, or ``auto``: the latter from 1500 px a line on, below which
    a quarter of the size shows too little. An option that is None takes the value of the matcher. The search range is
    given in heights over the plane of zero disparity, mm, positive towards the cameras: -26.9..25.2 is -165..+165 px on
    the full 3DPIXA and the same 52 mm on any other rig. ``lambda1`` and ``lambda2`` penalise a change of disparity by
    one and by more, per pixel of the block. ``left_right_check_px`` is the largest disagreement of the two views,
    ``fine_check_px`` that of the finer search. Patches of disparity smaller than ``speckle_px`` are removed.
    ``refine_iterations`` of local least squares over a window of ``refine_window`` px follow; 0 leaves the sixteenths
    of a pixel of ``sgbm``, which lean towards whole ones. A pixel whose sigma then exceeds ``largest_sigma_px`` is
    dropped where its match explains none of the grey values around it, and where it exceeds 7 times as much however
    much its match explains, with limits between for shares between: how often a disparity is wrong depends on both. Of
    the pixels kept on rendered rails 1 in 1800 is wrong by more than a pixel. Infinity keeps all. A pixel is dropped,
    too, unless the slopes of the grey values around it exceed those of noise by ``texture_confidence`` standard
    deviations: in noise alone every pixel finds a match.
    ``block_lines`` are matched as one, with ``halo_lines`` beyond either end that are thrown away: blocks lie at
    multiples of their size in the scan, so that a line's disparity depends on nothing else. Workers take
    ``strip_lines`` at once, rounded up to whole blocks.
    """

    matcher: Matcher = "auto"
    height_range_mm: Interval = (-26.9, 25.2)
    block_size: OddInt = 5
    lambda1: NonNegative = 8.0
    lambda2: NonNegative = 32.0
    left_right_check_px: NonNegativeInt = 10
    fine_check_px: NonNegativeInt = 2
    uniqueness_percent: Percent = 5
    speckle_px: NonNegativeInt = 100
    refine_iterations: NonNegativeInt | None = None
    refine_window: OddIntFrom3 = 9
    refine_noise: Positive = 2.0  # grey values, of 255
    largest_sigma_px: PositiveOrInfinite | None = None
    texture_confidence: NonNegative = 4.0
    block_lines: PositiveInt = 1024
    halo_lines: NonNegativeInt | None = None
    strip_lines: PositiveInt = 1024

    @property
    def work_lines(self) -> int:
        """Lines that a worker takes at once: whole blocks."""
        return -(-self.strip_lines // self.block_lines) * self.block_lines

    @property
    def tells_sigma(self) -> bool:
        """Whether the standard deviation of a disparity is known: refinement gives it."""
        return self.refine_iterations != 0

    def for_width(self, width: int) -> "DisparityConfig":
        """The same for lines of ``width`` px: the matcher chosen, and its own value of every option that is None."""
        matcher = self.matcher
        if matcher == "auto" and width >= COARSE_TO_FINE_PX:
            matcher = "coarse_to_fine"
        own = VARIANTS[matcher]
        return replace(
            self,
            matcher="sgbm" if matcher == "auto" else matcher,
            refine_iterations=own.refine_iterations if self.refine_iterations is None else self.refine_iterations,
            largest_sigma_px=own.largest_sigma_px if self.largest_sigma_px is None else self.largest_sigma_px,
            halo_lines=own.halo_lines if self.halo_lines is None else self.halo_lines,
        )
