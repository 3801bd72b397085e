"""Scan -> Disparity -> depth: matching of strips, block by block."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import disparity_at_height
from lsvision.image.missing import missing_mask, missing_near
from lsvision.image.stereo.agreement import occluded
from lsvision.image.stereo.blocks import block_side, enlarged, repeated
from lsvision.image.stereo.clipping import UnusableSamples, holes_factor
from lsvision.image.stereo.coarse_to_fine import COARSEST, match_coarse_to_fine, without_speckles
from lsvision.image.stereo.gloss import RESIDUAL_NOISE, light_is_suspect, proven_by_detail
from lsvision.image.stereo.refine import RefineOptions, refine_disparity
from lsvision.image.stereo.relation import PairRelation, measure_relation
from lsvision.image.stereo.residuals import Misfit, usual_variance
from lsvision.image.stereo.seen_rows import SeenRows
from lsvision.image.stereo.sgbm import GrayPair, Search, match_sgbm
from lsvision.image.stereo.steps import step_evidence
from lsvision.image.tiling import HaloRange, by_rows
from lsvision.stages.disparity.config import COARSE_TO_FINE_PX, DisparityConfig
from lsvision.stages.disparity.gray_lines import GrayLines
from lsvision.types import Rig, StereoPair, TensorImage

# Times the pixels of a speckle: where the refinement has dropped most of a wrong patch, under glare, the rest is wrong.
_LEFT_OVER = 4
_BLANK_TEST_STEP = 9  # every ninth line shows whether a camera saw anything


@dataclass(frozen=True)
class StripMatch:
    """Disparity of a strip and its sigma, px, ``(lines, width)``; NaN where there is no match.

    Without refinement sigma is unknown: NaN everywhere.
    """

    disparity: Tensor
    sigma: Tensor

    def occluded(self) -> Tensor:
        """Which pixels without disparity are hidden from the right camera; the others failed to match."""
        return occluded(self.disparity)


def disparity_range(rig: Rig, config: DisparityConfig) -> tuple[int, int]:
    """Lowest and highest disparity, px, of the configured heights on a rig."""
    low, high = (disparity_at_height(rig, height) for height in config.height_range_mm)
    return math.floor(low), math.ceil(high)


def measure_strip(left: Tensor, right: Tensor, rig: Rig, config: DisparityConfig) -> StripMatch:
    """Disparity and sigma of a pair of strips ``(lines, width, channels)``.

    A block in which one of the cameras saw no more than its noise has no match anywhere.
    """
    pair = StereoPair(TensorImage(left), TensorImage(right))
    relation = relation_of(pair, rig, config)
    blocks = [measure_block(pair, relation, rig, config, index) for index in range(-(-len(left) // config.block_lines))]
    if len(blocks) == 1:
        return blocks[0]
    return StripMatch(torch.cat([block.disparity for block in blocks]), torch.cat([block.sigma for block in blocks]))


def relation_of(pair: StereoPair, rig: Rig, config: DisparityConfig) -> PairRelation:
    """What the codes of a scan's two images mean, and how the right one differs apart from disparity."""
    width = pair.left.shape[1]
    config = config.for_width(width)
    size = COARSEST if width >= COARSE_TO_FINE_PX else 1
    return measure_relation(pair, _search_range(rig, config), config.refine_noise, size)


def measure_block(
    pair: StereoPair, relation: PairRelation, rig: Rig, config: DisparityConfig, index: int
) -> StripMatch:
    """Disparity and sigma of the lines of one block, of images of any length.

    Args:
        relation: of the two images, ``relation_of`` the whole scan.
        index: of the block, which begins at line ``index * config.block_lines``.
    """
    start = index * config.block_lines
    return measure_lines(pair, relation, rig, config, range(start, start + config.block_lines))


def measure_lines(
    pair: StereoPair, relation: PairRelation, rig: Rig, config: DisparityConfig, wanted: range
) -> StripMatch:
    """Disparity and sigma of some lines, matched as one, of images of any length; those beyond the end are left out.

    Lines belong to the left image: where the cameras are out of step, the right one is read that many lines later.
    """
    config, shift, levels = config.for_width(pair.left.shape[1]), relation.rows.whole, relation.levels
    lines = HaloRange.at(wanted.start, len(wanted), config.halo_lines or 0, pair.left.shape[0])
    outer = range(lines.outer_start, lines.outer_stop)
    left = GrayLines.read(pair.left, outer, levels.left, levels.white)
    right = GrayLines.read(pair.right, range(outer.start + shift, outer.stop + shift), levels.right, levels.white)
    unusable = UnusableSamples(left.unusable, right.unusable)
    gray_left, gray_right = left.gray, relation.as_bright_as_left(right.gray)
    with_gain = relation.exposure is not None or config.matcher == "sgbm"
    missing = _missing(pair, lines, shift)  # blank in both images, they fit any disparity alike
    if bool(missing.any()):
        mean = _mean_of(gray_left[~missing])
        gray_left, gray_right = (image.masked_fill(missing[:, None], mean) for image in (gray_left, gray_right))
        unusable = unusable.on_lines(~missing)
    seen = SeenRows.of(pair.left, pair.right, outer, shift)
    match = _measure(GrayStrip(gray_left, gray_right, unusable, seen), rig, config, with_gain=with_gain)
    partner = torch.arange(lines.start, lines.stop) + shift
    spoiled = missing_near(missing, config.refine_window)[lines.inner]
    disparity, sigma = (values[lines.inner] for values in (match.disparity, match.sigma))
    for values in (disparity, sigma):
        values[(partner < 0) | (partner >= pair.right.shape[0]) | spoiled] = torch.nan
    return StripMatch(disparity, sigma)


def _missing(pair: StereoPair, lines: HaloRange, shift: int) -> Tensor:
    """Lines that one of the images lacks, of a range and its halo."""
    own = torch.arange(lines.outer_start, lines.outer_stop)
    return missing_mask(pair.left, own) | missing_mask(pair.right, own + shift)


def _mean_of(values: Tensor) -> int:
    """Mean grey value, whole; 0 of none."""
    return round(float(values.float().mean())) if values.numel() else 0


@dataclass(frozen=True)
class GrayStrip:
    """Grey values of a pair of strips, the samples that must not be matched, and what both show; None for all rows."""

    left: Tensor
    right: Tensor
    unusable: UnusableSamples
    seen: SeenRows | None


def _measure(strip: GrayStrip, rig: Rig, config: DisparityConfig, *, with_gain: bool) -> StripMatch:
    """Disparity and sigma of a pair of grey images: search, then refinement.

    Args:
        with_gain: the refinement takes a factor between their brightnesses for an unknown.
    """
    left, right, unusable = strip.left, strip.right, strip.unusable
    # In noise alone every pixel would find a match somewhere.
    if any(float(image[::_BLANK_TEST_STEP].float().std()) <= config.refine_noise for image in (left, right)):
        return StripMatch(torch.full(left.shape, torch.nan), torch.full(left.shape, torch.nan))
    searched = _search(strip, rig, config)
    block, (lines, width) = block_side(left, searched), left.shape
    disparity = unusable.removed_from(searched, block)
    if not config.refine_iterations:
        disparity = enlarged(disparity, block)[:lines, :width]
        return StripMatch(disparity, torch.full_like(disparity, torch.nan))
    options = RefineOptions(
        window=config.refine_window,
        iterations=config.refine_iterations,
        noise=config.refine_noise,
        largest_sigma_px=config.largest_sigma_px or math.inf,
        with_gain=with_gain,
        texture_confidence=config.texture_confidence,
    )
    refined = refine_disparity(left, right, disparity, options)
    own, light_variance = refined.disparity, None
    usual = usual_variance(refined.residual_variance, block)
    if light_is_suspect(left, right, own, unusable, usual):
        largest = max(options.noise**2, usual / RESIDUAL_NOISE)
        noise = (refined.residual_variance / RESIDUAL_NOISE).clamp_(max=largest)
        proof = proven_by_detail(left, right, own, noise, options.window_blocks(block))
        own, light_variance = own.masked_fill(~proof.proven, torch.nan), proof.variance
    own = without_speckles(own, _LEFT_OVER * config.speckle_px)
    misfit = Misfit.of(refined.residual_variance, block)
    factor = misfit.factor
    if disparity is not searched:
        factor = factor * holes_factor(searched, disparity, options.window_blocks(block))
    lowest_px = float(disparity_range(rig, config)[0])
    surface = own if strip.seen is None else strip.seen.extended(own, block)
    steps = step_evidence(left, right, surface, misfit.noise_variance, lowest_px)
    own = by_rows(lambda values, refuted: values.masked_fill(refuted, torch.nan), own, steps.refuted)
    variance = steps.variance if light_variance is None else steps.variance.add_(light_variance)
    sigma = by_rows(_sigma, variance, factor, refined.sigma, own)
    return StripMatch(enlarged(own, block)[:lines, :width], repeated(sigma, block)[:lines, :width])


def _sigma(variance: Tensor, factor: Tensor, refined: Tensor, disparity: Tensor) -> Tensor:
    """Sigma with a variance besides that of the refinement, which grows by a factor; NaN where the disparity is."""
    return torch.addcmul(variance, factor, refined * refined).sqrt_().add_(disparity - disparity)


def _search(strip: GrayStrip, rig: Rig, config: DisparityConfig) -> Tensor:
    """Disparity of a pair of grey images by the configured matcher, for each pixel or for each 2 x 2 pixels."""
    search = _search_range(rig, config)
    pair = GrayPair.of(strip.left[..., None], strip.right[..., None], white=255.0)
    if config.matcher == "sgbm":
        return match_sgbm(pair, search)
    check_px, noise = config.fine_check_px, config.refine_noise
    return match_coarse_to_fine(pair, search, fine_check_px=check_px, noise=noise, seen=strip.seen)


def _search_range(rig: Rig, config: DisparityConfig) -> Search:
    """What is searched for on a rig."""
    minimum_px, maximum_px = disparity_range(rig, config)
    return Search(
        minimum_px=minimum_px,
        maximum_px=maximum_px,
        block_size=config.block_size,
        small_change_penalty=round(config.lambda1 * config.block_size**2),
        large_change_penalty=round(config.lambda2 * config.block_size**2),
        left_right_check_px=config.left_right_check_px,
        uniqueness_percent=config.uniqueness_percent,
        speckle_px=config.speckle_px,
    )
