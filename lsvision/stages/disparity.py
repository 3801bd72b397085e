"""Scan -> Disparity -> depth: matching strip by strip, and the depth map that follows from it."""

import math
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.geometry import depth_at
from lsvision.image.agreement import occluded
from lsvision.image.brightness import gray, gray_bytes, white_level
from lsvision.image.matching import match_sgbm
from lsvision.image.pyramid_matching import match_coarse_to_fine
from lsvision.image.refinement import enlarged, refine_disparity
from lsvision.types import LineImage, Rig, Scan, TensorImage

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


@dataclass(frozen=True)
class StripMatch:
    """Disparity of a strip and its standard deviation, px, ``(lines, width)``; NaN where there is no match.

    Without refinement nothing is known about the deviation: it is NaN everywhere.
    """

    disparity: Tensor
    sigma: Tensor

    def occluded(self) -> Tensor:
        """Which pixels without disparity are hidden from the right camera; the others failed to match."""
        return occluded(self.disparity)


def disparity_range(rig: Rig, config: DisparityConfig) -> tuple[int, int]:
    """Lowest and highest disparity, px, that the configured heights ask for on a rig."""
    convergence = rig.principal_right_px - rig.principal_left_px
    z0 = rig.zero_disparity_mm
    low, high = (convergence * (z0 / (z0 - height) - 1) for height in config.height_range_mm)
    return math.floor(low), math.ceil(high)


def match_strip(left: Tensor, right: Tensor, rig: Rig, config: DisparityConfig) -> Tensor:
    """Disparity, px, of a pair of strips ``(lines, width, channels)``; NaN where there is no match."""
    return measure_strip(left, right, rig, config).disparity


def measure_strip(left: Tensor, right: Tensor, rig: Rig, config: DisparityConfig) -> StripMatch:
    """Disparity of a pair of strips ``(lines, width, channels)`` and how well it is known.

    Nothing is found in a block where one of the cameras saw no more than its noise.
    """
    pair = TensorImage(left), TensorImage(right)
    white = white_level(*pair)
    blocks = [_measure_block(*pair, rig, config, white, index) for index in range(-(-len(left) // config.block_lines))]
    if len(blocks) == 1:
        return blocks[0]
    return StripMatch(torch.cat([block.disparity for block in blocks]), torch.cat([block.sigma for block in blocks]))


def _measure_block(
    left: LineImage, right: LineImage, rig: Rig, config: DisparityConfig, white: float, index: int
) -> StripMatch:
    """Disparity of the block of some index, of images of any length."""
    start, lines = index * config.block_lines, left.shape[0]
    stop = min(start + config.block_lines, lines)
    above, below = max(start - config.halo_lines, 0), min(stop + config.halo_lines, lines)
    match = _measure(left.read(above, below), right.read(above, below), rig, config.for_width(left.shape[1]), white)
    inner = slice(start - above, stop - above)
    return StripMatch(match.disparity[inner], match.sigma[inner])


def _measure(left: Tensor, right: Tensor, rig: Rig, config: DisparityConfig, white: float) -> StripMatch:
    left, right = _gray(left, white), _gray(right, white)
    disparity = _search(left, right, rig, config)
    if not config.refine_iterations:
        lines, width = left.shape
        disparity = enlarged(disparity, -(-lines // disparity.shape[0]))[:lines, :width]
        return StripMatch(disparity, torch.full_like(disparity, torch.nan))
    refined = refine_disparity(
        left,
        right,
        disparity,
        window=config.refine_window,
        iterations=config.refine_iterations,
        noise=config.refine_noise,
        largest_sigma_px=config.largest_sigma_px,
    )
    return StripMatch(refined.disparity, refined.sigma)


def _search(left: Tensor, right: Tensor, rig: Rig, config: DisparityConfig) -> Tensor:
    # Every tenth or so line tells whether a camera saw anything: in noise alone all would be found to match somewhere.
    if any(float(image[::9].float().std()) <= config.refine_noise for image in (left, right)):
        return torch.full(left.shape, torch.nan)
    minimum_px, maximum_px = disparity_range(rig, config)
    options: dict[str, Any] = {
        "minimum_px": minimum_px,
        "maximum_px": maximum_px,
        "block_size": config.block_size,
        "lambda1": config.lambda1,
        "lambda2": config.lambda2,
        "left_right_check_px": config.left_right_check_px,
        "uniqueness_percent": config.uniqueness_percent,
        "speckle_px": config.speckle_px,
        "white": 255.0,
    }
    left, right = left[..., None], right[..., None]
    if config.matcher == "sgbm":
        return match_sgbm(left, right, **options)
    return match_coarse_to_fine(left, right, **options, fine_check_px=config.fine_check_px, noise=config.refine_noise)


def _gray(image: Tensor, white: float) -> Tensor:
    """Brightness on a scale of 0..255, on which the noise is given."""
    return gray_bytes(image) if image.dtype == torch.uint8 else gray(image) * (255.0 / white)


def depth_sigma(depth: Tensor, sigma: Tensor, rig: Rig) -> Tensor:
    """Standard deviation of depths, mm, from that of their disparities, px: ``dz/dd = -z² / (f B)``."""
    return depth.square() * (sigma / (rig.focal_length_px * rig.baseline_mm))


@dataclass
class MatchedDepth:
    """The depth map of a stereo scan as a ``LineImage``: float32 z in mm, NaN for none, matched where it is read.

    The last blocks stay in memory, since neighbouring reads overlap.
    """

    scan: Scan
    config: DisparityConfig = field(default_factory=DisparityConfig)
    kept_blocks: int = 3
    _blocks: OrderedDict[int, tuple[Tensor, Tensor]] = field(default_factory=OrderedDict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, 1)."""
        return self.scan.lines, self.scan.rig.width_px, 1

    @property
    def dtype(self) -> torch.dtype:
        """float32."""
        return torch.float32

    def read(self, start: int, stop: int) -> Tensor:
        """Depth of lines ``start..stop-1``, ``(stop - start, width, 1)`` in mm."""
        return self._read(start, stop, 0)

    def read_sigma(self, start: int, stop: int) -> Tensor:
        """Standard deviation of the depth of lines ``start..stop-1``, ``(stop - start, width, 1)`` in mm."""
        return self._read(start, stop, 1)

    def _read(self, start: int, stop: int, which: Literal[0, 1]) -> Tensor:
        size = self.config.block_lines
        first, last = start // size, (stop - 1) // size
        blocks = [self._block(index)[which] for index in range(first, last + 1)]
        lines = slice(start - first * size, stop - first * size)
        return (blocks[0] if len(blocks) == 1 else torch.cat(blocks))[lines, :, None]

    def _block(self, index: int) -> tuple[Tensor, Tensor]:
        if index not in self._blocks:
            self._blocks[index] = self._match(index)
            while len(self._blocks) > self.kept_blocks:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(index)
        return self._blocks[index]

    @cached_property
    def _white(self) -> float:
        assert self.scan.right is not None
        return white_level(self.scan.left, self.scan.right)

    def _match(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth and its standard deviation, each (lines, width)."""
        assert self.scan.right is not None
        match = _measure_block(self.scan.left, self.scan.right, self.scan.rig, self.config, self._white, index)
        depth = depth_at(self.scan.rig, match.disparity)
        return depth, depth_sigma(depth, match.sigma, self.scan.rig)


def depth_of(scan: Scan, config: DisparityConfig) -> LineImage:
    """The scan's own depth map where a camera computed one, else the one matched from its two images."""
    return scan.depth if scan.depth is not None else MatchedDepth(scan, config)
