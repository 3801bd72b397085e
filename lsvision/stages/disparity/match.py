"""Scan -> Disparity -> depth: matching strip by strip, and the depth map that follows from it."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lsvision.image.brightness import gray, gray_bytes, white_level
from lsvision.image.stereo.agreement import occluded
from lsvision.image.stereo.coarse_to_fine import match_coarse_to_fine
from lsvision.image.stereo.refine import enlarged, refine_disparity
from lsvision.image.stereo.sgbm import match_sgbm
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import LineImage, Rig, TensorImage


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
    blocks = [measure_block(*pair, rig, config, white, index) for index in range(-(-len(left) // config.block_lines))]
    if len(blocks) == 1:
        return blocks[0]
    return StripMatch(torch.cat([block.disparity for block in blocks]), torch.cat([block.sigma for block in blocks]))


def measure_block(
    left: LineImage, right: LineImage, rig: Rig, config: DisparityConfig, white: float, index: int
) -> StripMatch:
    """Disparity of the block of some index, of images of any length."""
    config = config.for_width(left.shape[1])
    start, lines, halo = index * config.block_lines, left.shape[0], config.halo_lines or 0
    stop = min(start + config.block_lines, lines)
    above, below = max(start - halo, 0), min(stop + halo, lines)
    match = _measure(left.read(above, below), right.read(above, below), rig, config, white)
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
