"""From a product in memory to candidates: place, depth, kind, and nothing where nothing is."""

from dataclasses import replace

import cv2
import pytest
import torch

from lsvision.errors import LsvisionError
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.inspect import SurfacePlan, find_candidates
from tests.stages.surface.products import PITCH_MM, MemoryProduct, dented, places, rail

CONFIG = SurfaceConfig(smoothing_mm=0.6, matching_blur=0.0)


def found(product, config=CONFIG, written=lambda strip: None):
    return find_candidates(product, SurfacePlan.of(product, config), config, written).candidates


@pytest.mark.parametrize("shaken_mm", [0.0, 0.4])
def test_dents_and_bumps_are_found_where_they_are_as_deep_as_they_are(shaken_mm):
    product = rail(900, shaken_mm=shaken_mm)
    for along, across, depth in ((40.0, 0.0, 0.2), (110.0, 14.0, 0.3), (150.0, -17.0, -0.2)):
        product = dented(product, along, across, 3.0, depth)
    candidates = sorted(found(product), key=lambda one: one.along_mm)
    assert [one.kind for one in candidates] == ["dent", "dent", "bump"]
    for one, (along, across, depth) in zip(
        candidates, ((40.0, 0.0, 0.2), (110.0, 14.0, 0.3), (150.0, -17.0, -0.2)), strict=True
    ):
        assert one.along_mm == pytest.approx(along, abs=0.1)
        assert one.across_mm == pytest.approx(across, abs=0.3 + shaken_mm)
        assert one.depth_mm == pytest.approx(-depth, abs=0.012)
        assert one.volume_mm3 * depth < 0
        assert 4.0 < one.width_mm <= one.length_mm < 6.5


@pytest.mark.parametrize(("blur", "off_mm"), [(2.0, 0.01), (0.0, 0.04)])
def test_depth_makes_good_what_the_matching_blurs(blur, off_mm):
    product = dented(rail(600, noise_mm=0.0), 60.0, 0.0, 3.0, 0.3)
    rows = cv2.GaussianBlur(product.heights.numpy(), (13, 13), 2.0)
    noise = 0.002 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(0))
    heights = torch.where(places(*rows.shape)[1].abs() < 22.0, torch.from_numpy(rows) + noise, torch.nan).float()
    (one,) = found(replace(product, heights=heights), replace(CONFIG, matching_blur=blur))
    assert abs(one.depth_mm + 0.3) < off_mm
    assert (blur > 0) == (abs(one.depth_mm + 0.3) < 0.01)


@pytest.mark.parametrize("seed", range(4))
def test_sound_surface_has_no_candidates(seed):
    assert found(rail(900, seed=seed, shaken_mm=0.3 * (seed % 2))) == []


def test_a_defect_over_the_border_of_strips_is_one():
    product = dented(rail(1200), 5.0 + 512 * PITCH_MM, 3.0, 4.0, 0.3)
    (one,) = found(product)
    assert one.first_row < 512 <= one.last_row


def test_dark_places_are_candidates_by_colour_and_dents_are_not_twice():
    product = dented(rail(900), 60.0, 0.0, 3.0, 0.3)
    colors = product.colors.clone()
    for row in (275, 600):  # on the dent, and elsewhere
        colors[row - 10 : row + 10, 140:160] //= 3
    candidates = found(replace(product, colors=colors))
    assert sorted(one.kind for one in candidates) == ["color", "dent"]
    dark = next(one for one in candidates if one.kind == "color")
    assert dark.along_mm == pytest.approx(5.0 + 600 * PITCH_MM, abs=0.3)
    assert -0.67 < dark.contrast < -0.3
    assert dark.depth_mm != dark.depth_mm  # NaN


def test_deviation_is_along_the_normal_and_its_sigma_covers_it():
    product = rail(600, noise_mm=0.01)
    strips = []
    found(product, written=strips.append)
    deviation, sigma = (torch.cat([getattr(strip, name) for strip in strips]) for name in ("deviation", "sigma"))
    assert deviation.shape == sigma.shape == (600, deviation.shape[1])
    ratio = (deviation / sigma)[:, 30:-30]
    assert 0.8 < float(ratio.square().nanmean().sqrt()) < 1.25


def test_stated_sigma_of_the_product_is_that_of_the_deviation():
    product = rail(300)
    sigmas = torch.full((*product.heights.shape, 3), 0.02)
    strips = []
    found(replace(product, sigmas=sigmas), written=strips.append)
    middle = strips[0].sigma[:, strips[0].sigma.shape[1] // 2]
    assert float(middle.nanmedian()) == pytest.approx(0.02, rel=0.01)


def test_ground_before_and_behind_is_another_object():
    product = dented(rail(900), 90.0, 0.0, 3.0, 0.3)
    heights = product.heights.clone()
    heights[:150] = heights[750:] = -30.0
    strips = []
    (one,) = found(replace(product, heights=heights), written=strips.append)
    assert one.along_mm == pytest.approx(90.0, abs=0.1)
    assert not bool(strips[0].deviation[:150].isfinite().any())


@pytest.mark.parametrize("heights", [torch.full((200, 100), torch.nan), 5 * torch.randn(200, 100).sign()])
def test_no_profile_is_one_line(heights):
    product = MemoryProduct(heights, torch.zeros(200, 100, 1, dtype=torch.uint8))
    if bool(heights.isfinite().any()):
        product = replace(product, heights=heights.where(places(200, 100)[1].abs() < 0.3, torch.nan).float())
    with pytest.raises(LsvisionError, match="no profile"):
        found(product)


def test_thresholds_must_be_in_order():
    with pytest.raises(LsvisionError, match="low_sigma: expected at most high_sigma"):
        SurfaceConfig(low_sigma=9.0)
