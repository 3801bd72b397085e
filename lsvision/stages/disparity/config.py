"""Options of the matching."""

from dataclasses import dataclass, replace
from typing import Literal

from lsvision.errors import ConfigError

_COARSE_TO_FINE_PX = 1500  # from this width on a quarter of the size is enough to search in


@dataclass(frozen=True)
class DisparityConfig:
    """How two images are matched.

    ``matcher`` is ``sgbm``, one pass over the whole range as in the paper, ``coarse_to_fine``, the whole range at a
    quarter of the size and a few disparities at half of it, or ``auto``: the latter from 1500 px a line on, below which
    too little is left at a quarter of the size. The search range is given in heights over the plane of zero disparity,
    mm, positive towards the cameras: -26.9..25.2 is -165..+165 px on the full 3DPIXA and the same 52 mm on any other
    rig. ``lambda1`` and ``lambda2`` penalise a change of disparity by one and by more, per pixel of the block.
    ``left_right_check_px`` is the largest disagreement of the two views, ``fine_check_px`` that of the finer search.
    ``refine_iterations`` of local least squares over a window of ``refine_window`` px follow, as many as the matcher
    needs where it is None; 0 leaves the sixteenths of a pixel of ``sgbm``, which lean towards whole ones. A pixel that
    is then known no better than ``largest_sigma_px``, though its residual is more than noise, is dropped, and so is one
    known five times less well.
    ``block_lines`` are matched as one, with ``halo_lines`` beyond either end that are thrown away: blocks lie at
    multiples of their size in the scan, so that a line's disparity depends on nothing else. Workers take
    ``strip_lines`` at once, rounded up to whole blocks.
    """

    matcher: Literal["auto", "sgbm", "coarse_to_fine"] = "auto"
    height_range_mm: tuple[float, float] = (-26.9, 25.2)
    block_size: int = 5
    lambda1: float = 8.0
    lambda2: float = 32.0
    left_right_check_px: int = 10
    fine_check_px: int = 2
    uniqueness_percent: int = 5
    speckle_px: int = 100
    refine_iterations: int | None = None
    refine_window: int = 9
    refine_noise: float = 2.0  # grey values, of 255
    largest_sigma_px: float | None = None
    block_lines: int = 1024
    halo_lines: int = 48
    strip_lines: int = 1024

    def __post_init__(self) -> None:
        for name, least in (("block_lines", 1), ("strip_lines", 1), ("halo_lines", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"disparity.{name}: expected at least {least}, got {getattr(self, name)}")

    @property
    def work_lines(self) -> int:
        """Lines that a worker takes at once: whole blocks."""
        return -(-self.strip_lines // self.block_lines) * self.block_lines

    @property
    def tells_sigma(self) -> bool:
        """Whether the standard deviation of a disparity is known: refinement tells it."""
        return self.refine_iterations != 0

    def for_width(self, width: int) -> "DisparityConfig":
        """The same with what is left open settled for lines of ``width`` px."""
        matcher = self.matcher
        if matcher == "auto":
            matcher = "coarse_to_fine" if width >= _COARSE_TO_FINE_PX else "sgbm"
        iterations = self.refine_iterations
        if iterations is None:
            iterations = 1 if matcher == "coarse_to_fine" else 2  # the former has refined already, at half the size
        return replace(self, matcher=matcher, refine_iterations=iterations)
