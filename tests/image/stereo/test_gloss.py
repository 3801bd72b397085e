"""Gloss that both cameras see matches itself; details of the surface do not come from light."""

import pytest
import torch

from lsvision.image.stereo.clipping import UnusableSamples
from lsvision.image.stereo.gloss import light_is_suspect, proven_by_detail
from tests.image.stereo.test_refine import texture

LINES, WIDTH, DISPARITY, NOISE = 64, 240, 6.0, 1.0
NONE = UnusableSamples(None, None)
COLUMN = torch.arange(float(WIDTH))


def noisy(image: torch.Tensor, seed: int) -> torch.Tensor:
    return image + NOISE * torch.randn(LINES, WIDTH, generator=torch.Generator().manual_seed(seed))


def stripe(centre: float, width: float = 12.0) -> torch.Tensor:
    """A gloss along the scan."""
    return (120 * torch.exp(-((COLUMN - centre) / width).square() / 2)).expand(LINES, WIDTH)


def edge(column: float) -> torch.Tensor:
    """A sharp edge along the scan."""
    return (40 + 100 * torch.sigmoid(2 * (COLUMN - column))).expand(LINES, WIDTH)


def grain(disparity: float) -> torch.Tensor:
    """A surface with grain."""
    return texture(torch.full((), disparity))


def everywhere(block: int = 1) -> torch.Tensor:
    """The disparity of all blocks that have a partner."""
    disparity = torch.full((LINES // block, WIDTH // block), DISPARITY)
    disparity[:, : 16 // block] = torch.nan
    return disparity


def proven(left: torch.Tensor, right: torch.Tensor, disparity: float = DISPARITY, block: int = 1) -> torch.Tensor:
    """Where a match is proven, away from the ends of the lines."""
    blocks = torch.full((LINES // block, WIDTH // block), disparity)
    found = proven_by_detail(
        noisy(left, 1), noisy(right, 2), blocks, torch.full_like(blocks, 1.25 * NOISE**2), 2 * (9 // (2 * block)) + 1
    ).proven
    return found[:, 16 // block : -16 // block]


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("width", [4.0, 12.0, 40.0])
def test_a_gloss_is_no_proof_although_it_matches(width, block):
    left, right = (60 + stripe(120.0 - shift, width) for shift in (0, DISPARITY))
    assert proven(left, right, block=block).float().mean() < 0.02


@pytest.mark.parametrize("block", [1, 2])
def test_grain_proves_a_match_and_refutes_another(block):
    left, right = grain(0.0), grain(DISPARITY)
    assert proven(left, right, block=block).float().mean() > 0.9
    assert proven(left, right, DISPARITY + 4, block).float().mean() < 0.05


def test_a_gloss_that_matches_does_not_carry_the_grain_below_it():
    left, right = 0.3 * grain(0.0) + stripe(120.0), 0.3 * grain(0.0) + stripe(120.0 - DISPARITY)
    assert proven(left, right)[:, 90:120].float().mean() < 0.05
    assert proven(left, right, 0.0).float().mean() > 0.85


@pytest.mark.parametrize("block", [1, 2])
def test_a_sharp_edge_is_no_light(block):
    found = proven(edge(120.0), edge(120.0 - DISPARITY), block=block)
    beside, aside = (found[:, (column - 16) // block] for column in (122, 160))
    assert beside.float().mean() > 0.9
    assert aside.float().mean() < 0.01
    assert proven(edge(120.0), edge(120.0 - DISPARITY), DISPARITY + 3, block).float().mean() < 0.02


def test_what_does_not_match_proves_nothing_about_its_neighbours():
    left, right = grain(0.0), grain(DISPARITY)
    whole = torch.full((LINES, WIDTH), DISPARITY)
    part = whole.clone()
    part[:, 100:] = torch.nan
    noise = torch.ones_like(whole)
    alone = proven_by_detail(left, right, whole, noise, 9).proven
    left[:, 100:] = 255.0
    found = proven_by_detail(left, right, part, noise, 9).proven
    assert torch.equal(found[:, :95], alone[:, :95])
    assert found[:, 95:99].float().mean() > 0.7
    assert not found[:, 105:].any()


@pytest.mark.parametrize("block", [1, 2])
def test_equal_light_is_not_suspect_and_other_light_is(block):
    left, right = noisy(grain(0.0), 1), noisy(grain(DISPARITY), 2)
    disparity = everywhere(block)
    assert not light_is_suspect(left, right, disparity, NONE, 2.0)
    assert light_is_suspect(left + stripe(120.0), right + stripe(90.0), disparity, NONE, 2.0)
    assert not light_is_suspect(left, right, torch.full_like(disparity, torch.nan), NONE, 2.0)


def test_noise_is_no_other_light():
    noise = torch.randn(2, LINES, WIDTH, generator=torch.Generator().manual_seed(4))
    left, right = grain(0.0) + 20 * noise[0], grain(DISPARITY) + 20 * noise[1]
    assert not light_is_suspect(left, right, everywhere(), NONE, 800.0)
    assert light_is_suspect(left, right, everywhere(), NONE, 2.0)


def test_saturated_areas_are_suspect_and_single_samples_are_not():
    left, right = grain(0.0), grain(DISPARITY)
    disparity = everywhere()
    single, area = (torch.zeros(LINES, WIDTH, dtype=torch.bool) for _ in range(2))
    single[torch.rand(LINES, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.1] = True
    area[20:30, 40:52] = True
    assert not light_is_suspect(left, right, disparity, UnusableSamples(single, single), 2.0)
    assert not light_is_suspect(left, right, disparity, UnusableSamples(None, area), 2.0)  # a brighter camera
    assert light_is_suspect(left, right, disparity, UnusableSamples(area, area), 2.0)


def test_images_of_odd_sizes():
    left, right = grain(0.0)[:-1, :-1], grain(DISPARITY)[:-1, :-1]
    disparity = everywhere(2)
    assert not light_is_suspect(left, right, disparity, NONE, 2.0)
    found = proven_by_detail(left, right, disparity, torch.ones_like(disparity), 5).proven
    assert found[:, 16:-8].float().mean() > 0.85


def test_tiles_leave_no_trace():
    left, right = (torch.cat([0.3 * grain(shift) + stripe(120.0 - shift / 2)] * 5) for shift in (0.0, DISPARITY))
    disparity = torch.full(left.shape, DISPARITY)
    noise = torch.ones_like(disparity)
    cut = 64  # lines by which the tiles are moved
    whole = proven_by_detail(left, right, disparity, noise, 9)
    later = proven_by_detail(left[cut:], right[cut:], disparity[cut:], noise[cut:], 9)
    assert 0.2 < whole.proven.float().mean() < 0.9
    assert torch.equal(whole.proven[cut + 8 :], later.proven[8:])
    assert torch.equal(whole.variance[cut + 8 :], later.variance[8:])


@pytest.mark.parametrize("block", [1, 2])
def test_light_that_changes_along_the_line_adds_to_the_variance(block):
    """A slope of g grey values a px, over s of the texture, looks like a shift of g / s times the columns' spread."""
    slope, disparity = 0.8, everywhere(block)
    left, right = noisy(grain(0.0), 1), noisy(grain(DISPARITY), 2)
    noise, size = torch.full_like(disparity, 1.25 * NOISE**2), 2 * (9 // (2 * block)) + 1
    inner = slice(32 // block, -16 // block)
    even, sloped = (
        proven_by_detail(left + light, right, disparity, noise, size).variance[:, inner].sqrt().median()
        for light in (0.0, slope * COLUMN)
    )
    texture = 0.5 * (grain(0.0)[:, 2:] - grain(0.0)[:, :-2])
    spread = (((size * block) ** 2 - 1) / 12) ** 0.5
    assert even < 0.005
    assert 0.6 * spread * slope / texture.std() == pytest.approx(float(sloped), rel=0.3)
