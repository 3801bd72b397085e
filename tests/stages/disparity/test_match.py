"""Disparity and depth of strips: the search range, reads of any range, and the height of a rendered plane."""

import dataclasses
import functools
import math
from pathlib import Path

import pytest
import torch

from lsvision.geometry import (
    depth_at,
    depth_sigma,
    focal_length_px,
    triangulate,
    triangulation_jacobian,
    zero_disparity_mm,
)
from lsvision.image.brightness import gray
from lsvision.image.stereo.sgbm import GrayPair, match_sgbm
from lsvision.simulation import SceneConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import MatchedDepth, depth_of
from lsvision.stages.disparity.match import StripMatch, disparity_range, measure_strip
from lsvision.types import DepthView, Scan, StereoPair, StoredDepth, TensorImage, Travel
from tests.image.stereo.test_sgbm import search
from tests.stages.rendered import FULL_RIG, PITCH, SMALL_RIG, simulation, stereo_scan

CONFIG = DisparityConfig(block_lines=64, halo_lines=16)
FINE = DisparityConfig(
    matcher="coarse_to_fine", refine_iterations=1, largest_sigma_px=0.2, block_lines=64, halo_lines=32
)


@pytest.fixture(scope="module")
def sheet():
    source = simulation(SceneConfig("sheet", pitch_deg=2.0, roll_deg=1.5, texture_mm=1.5, margin_mm=0.0))
    return source, stereo_scan(source)


@pytest.fixture(scope="module")
def untiled(sheet):
    """The sheet's depth from its whole images at once."""

    @functools.cache
    def measured(config: DisparityConfig) -> torch.Tensor:
        left, right = (image.read(0, sheet[1].lines) for image in (sheet[1].left, sheet[1].images.right))
        return depth_at(SMALL_RIG, measure_strip(left, right, SMALL_RIG, config).disparity)

    return measured


def test_default_range_is_that_of_the_camera():
    low, high = disparity_range(FULL_RIG, DisparityConfig())
    assert abs(low + 165) <= 1
    assert abs(high - 165) <= 1
    small = disparity_range(SMALL_RIG, DisparityConfig())
    assert small == (math.floor(low / 16), math.ceil(high / 16))


def test_depth_equals_triangulation_pixel_by_pixel():
    disparity = torch.tensor([[0.0, 3.5, torch.nan, -7.25]])
    depth = depth_at(SMALL_RIG, disparity)
    assert depth.dtype == torch.float32
    assert depth[0, 0] == pytest.approx(zero_disparity_mm(SMALL_RIG))
    for column, value in enumerate(disparity[0].double()):
        expected = triangulate(SMALL_RIG, torch.tensor(float(column)).double(), value)[1]
        torch.testing.assert_close(depth[0, column].double(), expected, rtol=1e-6, atol=0, equal_nan=True)


@pytest.mark.parametrize("config", [CONFIG, FINE])
@pytest.mark.parametrize("strip_lines", [64, 100, 257, 10_000])
def test_strips_of_any_height_and_the_whole_are_equal(sheet, untiled, config, strip_lines):
    lines = sheet[1].lines
    tiled = MatchedDepth(sheet[1].images, sheet[1].rig, dataclasses.replace(config, strip_lines=strip_lines))
    parts = [tiled.read(start, min(start + strip_lines, lines)).z for start in range(0, lines, strip_lines)]
    assert torch.cat(parts).numpy().tobytes() == untiled(config).numpy().tobytes()


@pytest.mark.parametrize("config", [CONFIG, FINE])
def test_values_do_not_depend_on_the_range_read(sheet, config):
    scan = sheet[1]
    whole = MatchedDepth(scan.images, scan.rig, config).read(0, scan.lines).z
    assert whole.shape == (scan.lines, SMALL_RIG.width_px)
    lazy = MatchedDepth(scan.images, scan.rig, config, kept_blocks=2)
    for start, stop in ((0, 5), (60, 70), (100, 200), (63, 64), (scan.lines - 3, scan.lines), (10, 12)):
        torch.testing.assert_close(lazy.read(start, stop).z, whole[start:stop], rtol=0, atol=0, equal_nan=True)
        assert len(lazy._blocks) <= 2


@pytest.mark.parametrize("config", [CONFIG, dataclasses.replace(FINE, refine_iterations=2)])
def test_height_of_a_rendered_plane(sheet, config):
    source, scan = sheet
    depth = MatchedDepth(scan.images, scan.rig, config).read(0, scan.lines).z
    truth = torch.cat(list(source.depth_strips()))
    inside = (slice(40, -40), slice(80, -80))
    error_px = to_disparity(depth, truth)[inside]
    assert torch.isfinite(error_px).float().mean() > 0.95
    error_px = error_px[torch.isfinite(error_px)]
    assert error_px.square().mean().sqrt() < 0.05
    assert abs(error_px.mean()) < 0.01


def test_sigma_is_that_of_the_errors(sheet):
    source, scan = sheet
    matched = MatchedDepth(scan.images, scan.rig, CONFIG)
    read = matched.read(0, scan.lines)
    depth, sigma = read.z, read.sigma
    assert torch.equal(depth.isnan(), sigma.isnan())
    inside = (slice(40, -40), slice(80, -80))
    truth = torch.cat(list(source.depth_strips()))
    normalised = ((depth - truth) / sigma)[inside]
    # The median of |error| / sigma is 0.6745 of a normal distribution.
    assert abs(normalised.abs().nanmedian() / 0.6745 - 1) < 0.3


@pytest.mark.parametrize("config", [CONFIG, FINE])
def test_a_darker_right_camera_out_of_step_changes_little(sheet, config):
    source, scan = sheet
    left, right = scan.left.read(0, scan.lines), scan.images.right.read(0, scan.lines)
    late = 0.75 * right[(torch.arange(scan.lines) - 2).clamp(min=0)].float() + 8
    across = torch.linspace(-1, 1, right.shape[1])[None, :, None]
    other = (late * (1 - 0.3 * across.square())).round().to(torch.uint8)
    images = StereoPair(scan.left, TensorImage(other))
    matched = MatchedDepth(images, scan.rig, config)
    depth, inside = matched.read(0, scan.lines).z, (slice(40, -40), slice(80, -80))
    assert matched.relation.rows.whole == 2
    assert matched.relation.exposure is not None
    assert depth[-2:].isnan().all()
    truth = torch.cat(list(source.depth_strips()))
    equal = depth_at(SMALL_RIG, measure_strip(left, right, SMALL_RIG, config).disparity)
    error, expected = (to_disparity(each, truth)[inside] for each in (depth, equal))
    assert error.isfinite().float().mean() >= expected.isfinite().float().mean() - 0.003
    assert error.abs().nanmedian() <= 1.2 * expected.abs().nanmedian()
    apart = MatchedDepth(images, scan.rig, config, known_relation=matched.relation).read(70, 100).z
    torch.testing.assert_close(apart, depth[70:100], rtol=0, atol=0, equal_nan=True)


def test_sigma_of_depth_follows_the_triangulation():
    disparity, column = torch.tensor([-30.0, 0.0, 12.5]).double(), torch.tensor([10.0, 200.0, 400.0]).double()
    depth = triangulate(SMALL_RIG, column, disparity)[1]
    sigma = torch.tensor([0.02, 0.05, 0.3]).double()
    expected = triangulation_jacobian(SMALL_RIG, column, disparity)[:, 1, 1].abs() * sigma
    torch.testing.assert_close(depth_sigma(SMALL_RIG, depth, sigma), expected)


@pytest.mark.parametrize("config", [CONFIG, FINE])
def test_images_that_match_nothing(sheet, config):
    scan = sheet[1]
    left, right = scan.left.read(64, 192), scan.images.right.read(64, 192)
    black, white = torch.zeros_like(left), torch.full_like(left, 255)
    for pair in ((left, black), (black, right), (left, white)):
        match = measure_strip(*pair, SMALL_RIG, config)
        assert torch.isfinite(match.disparity).float().mean() < 0.1
    flat = measure_strip(black, black, SMALL_RIG, config)
    # Without any texture a match carries no information, and sigma shows it.
    assert not (flat.sigma < 0.1).any()


@pytest.mark.parametrize("config", [CONFIG, FINE])
def test_mono_and_sixteen_bit_scans_match_alike(sheet, config):
    scan = sheet[1]
    left, right = scan.left.read(64, 192), scan.images.right.read(64, 192)
    colour = measure_strip(left, right, SMALL_RIG, config).disparity
    mono = (gray(image).round().to(torch.uint8)[..., None] for image in (left, right))
    deep = (image.to(torch.int32).mul(257).to(torch.uint16) for image in (left, right))
    for pair in (mono, deep):
        other = measure_strip(*pair, SMALL_RIG, config).disparity
        both = torch.isfinite(colour) & torch.isfinite(other)
        assert both.float().mean() > 0.9 * torch.isfinite(colour).float().mean()
        assert (colour - other)[both].abs().median() < 0.01


def test_hidden_pixels_are_separated_from_failed_ones():
    disparity = torch.zeros(2, 40)
    disparity[:, 20:] = 6.0
    disparity[:, 14:20] = torch.nan
    disparity[:, 4:7] = torch.nan
    match = StripMatch(disparity, torch.full_like(disparity, 0.1))
    assert match.occluded()[0].nonzero()[:, 0].tolist() == list(range(14, 20))


def to_disparity(depth, truth):
    """Error of depths in pixels of disparity."""
    scale = focal_length_px(SMALL_RIG) * SMALL_RIG.baseline_mm
    return scale / depth.double() - scale / truth.double()


def test_no_refinement_is_the_matcher_alone(sheet):
    scan = sheet[1]
    left, right = scan.left.read(0, 64), scan.images.right.read(0, 64)
    config = dataclasses.replace(CONFIG, refine_iterations=0, block_lines=64, halo_lines=0)
    low, high = disparity_range(SMALL_RIG, config)
    expected = match_sgbm(GrayPair.of(left, right), search(low, high))
    depth = MatchedDepth(scan.images, scan.rig, config).read(0, 64).z
    torch.testing.assert_close(depth, depth_at(SMALL_RIG, expected), equal_nan=True)


def test_a_scan_with_a_depth_map_is_not_matched():
    image = TensorImage(torch.zeros(4, SMALL_RIG.width_px, 1, dtype=torch.uint8))
    depth = TensorImage(torch.full((4, SMALL_RIG.width_px, 1), 800.0))
    scan = Scan(Path("mapped"), SMALL_RIG, Travel(PITCH), DepthView(image, depth))
    assert depth_of(scan, CONFIG) == StoredDepth(depth)
    assert isinstance(depth_of(dataclasses.replace(scan, images=StereoPair(image, image)), CONFIG), MatchedDepth)
