"""Sub-pixel refinement: equal to loops, unbiased on pairs of known shift, and uncertain where there is no texture."""

import dataclasses
import math

import pytest
import torch

from lsvision.image.stereo.blocks import block_side, enlarged
from lsvision.image.stereo.refine import RefineOptions, refine_disparity
from lsvision.image.stereo.scatter import SigmaGains
from lsvision.image.stereo.sgbm import GrayPair, match_sgbm
from lsvision.image.stereo.shift import LeftWindows
from lsvision.image.stereo.warp import warp_cubic
from lsvision.image.stereo.windows import Windows
from tests.image.stereo.test_sgbm import search

LINES, WIDTH = 64, 240
INSIDE = (slice(8, -8), slice(24, -24))
REFINE = RefineOptions(window=9, iterations=2, noise=0.5)


def refine(left, right, start, options=REFINE, first_column=0):
    found = refine_disparity(left, right, start, options, first_column=first_column).disparity
    return enlarged(found, block_side(left, start))[: left.shape[0], : left.shape[1]]


def texture(shift: torch.Tensor, noise: float = 0.0) -> torch.Tensor:
    """A sum of waves of 8 to 28 px, seen at u + shift: band-limited, so that its value is known between the pixels."""
    generator = torch.Generator().manual_seed(5)
    count = 60
    length = 8.0 + 20.0 * torch.rand(count, generator=generator)
    heading = 2 * math.pi * torch.rand(count, generator=generator)
    phase = 2 * math.pi * torch.rand(count, generator=generator)
    v, u = torch.meshgrid(torch.arange(LINES).float(), torch.arange(WIDTH).float(), indexing="ij")
    across = torch.cos(heading) / length, torch.sin(heading) / length
    waves = across[0][:, None, None] * (u + shift) + across[1][:, None, None] * v
    return 120 + 7.0 * torch.sin(2 * math.pi * waves + phase[:, None, None]).sum(0) + noise * torch.randn(LINES, WIDTH)


def naive_cubic(row, position):
    """Catmull-Rom interpolation of a row, up to a pixel from its ends."""
    position = min(max(position, 1.0), len(row) - 2.0)
    base = min(math.floor(position), len(row) - 3)
    a, b, c, d = row[base - 1 : base + 3]
    t = position - base
    return b + t / 2 * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))


def naive_refinement(left, right, start, options):
    """Disparity and sigma at every pixel, by sums over the valid pixels of its window."""
    lines, width = start.shape
    pixels = [(i, j) for i in range(lines) for j in range(width)]
    valid, disparity = start.isfinite(), {p: float(start[p].nan_to_num()) for p in pixels}
    reach = options.window // 2
    windows = {
        (i, j): [(v, u) for v, u in pixels if abs(v - i) <= reach and abs(u - j) <= reach and valid[v, u]]
        for i, j in pixels
    }

    def mean(values, p):
        return sum(values[q] for q in windows[p]) / max(len(windows[p]), 1)

    def covariance(a, b, p):
        return mean({q: a[q] * b[q] for q in windows[p]}, p) - mean(a, p) * mean(b, p)

    inner = range(1, width - 1)
    slope = {(i, j): float(left[i, j + 1] - left[i, j - 1]) / 2 if j in inner else 0.0 for i, j in pixels}
    prior = 4 * options.noise**2 / options.window**2
    for _ in range(options.iterations):
        change = {p: mean(disparity, p) - disparity[p] for p in pixels}
        smooth = {p: disparity[p] + (change[p] if abs(change[p]) <= 0.5 else 0.0) for p in pixels}
        residual = {(i, j): float(left[i, j]) - naive_cubic(right[i].tolist(), j - smooth[i, j]) for i, j in pixels}
        step = {p: covariance(slope, residual, p) / (covariance(slope, slope, p) + prior) for p in pixels}
        disparity = {p: smooth[p] - min(max(step[p], -0.5), 0.5) for p in pixels}
    sigma = {}
    for p in pixels:
        count, texture, pull = len(windows[p]), covariance(slope, slope, p), covariance(slope, residual, p)
        variance = covariance(residual, residual, p) - pull**2 / (texture + prior)
        variance = max(variance * count / max(count - 2, 1), 1 / 6)
        true_texture = max(texture - variance * 0.5 / 1.6, 0) + prior
        sigma[p] = math.sqrt((texture + prior) * variance / max(count, 1)) / true_texture
    gains = SigmaGains.of(options.window, options.iterations)
    deviation = {p: min(max(mean(disparity, p) - disparity[p], -0.8), 0.8) for p in pixels}
    squared, wide = {p: deviation[p] ** 2 for p in pixels}, {p: mean(deviation, p) ** 2 for p in pixels}
    for p in pixels:
        predicted = gains.iterations * sigma[p]
        scatter = mean(squared, p) + min(gains.wide * mean(wide, p), (1.25 * gains.scatter**2 - 1) * mean(squared, p))
        sigma[p] = math.sqrt(0.92**2 * scatter + 0.08 * predicted**2 + 0.01**2)
    return tuple(torch.tensor([each[p] for p in pixels]).view(lines, width) for each in (disparity, sigma))


@pytest.mark.parametrize("iterations", [1, 2])
def test_equals_the_naive_loops(iterations):
    left, right = texture(torch.tensor(0.0), 2.0)[:11, 40:67], texture(torch.tensor(0.3), 2.0)[:11, 40:67]
    start = 0.5 * torch.randn(11, 27)
    start[3:5, 6:12] = torch.nan
    options = RefineOptions(window=5, iterations=iterations, noise=2.0, largest_change_px=9.0)
    refined = refine_disparity(left, right, start, options)
    disparity, sigma = naive_refinement(left, right, start, options)
    valid = start.isfinite()
    assert torch.equal(refined.disparity.isfinite(), valid)
    torch.testing.assert_close(refined.disparity[valid], disparity[valid], rtol=0, atol=1e-4)
    torch.testing.assert_close(refined.sigma[valid], sigma[valid], rtol=2e-3, atol=0)


@pytest.mark.parametrize("shift", [-3.4, 0.25, 2.5, 7.8])
def test_known_shift_is_recovered_without_bias(shift):
    left, right = texture(torch.tensor(0.0), 0.5), texture(torch.tensor(shift), 0.5)
    start = torch.full((LINES, WIDTH), float(round(shift)))
    error = (refine(left, right, start) - shift)[INSIDE]
    assert error.square().mean().sqrt() < 0.05
    assert abs(error.mean()) < 0.005


def test_pixel_locking_of_the_matcher_is_removed():
    slope = 4.0 / WIDTH  # disparities of 0..4 px, every fraction of a pixel equally often
    u = torch.arange(WIDTH).float()
    right = texture(torch.tensor(0.0), 0.5)
    truth = (u * slope).expand(LINES, WIDTH)
    left = texture(-truth, 0.5)  # left sees at u what right sees at u - d
    pair = [image.clamp(0, 255).round().to(torch.uint8)[..., None] for image in (left, right)]
    matched = match_sgbm(GrayPair.of(*pair), search(-8, 12))
    refined = refine(left, right, matched)

    def error_by_phase(disparity):
        """Bias by the fraction of the true disparity, in eight bins."""
        error, phase = (disparity - truth)[INSIDE], (truth % 1.0)[INSIDE]
        bins = (8 * phase).long()
        return torch.stack([error[bins == k].nanmean() for k in range(8)])

    assert torch.isfinite(matched[INSIDE]).float().mean() > 0.95
    error = (refined - truth)[INSIDE]
    error = error[torch.isfinite(error)]
    assert error.square().mean().sqrt() < 0.05
    assert abs(error.mean()) < 0.005
    locked, left_over = (error_by_phase(disparity).abs().max() for disparity in (matched, refined))
    assert left_over < 0.015 < 0.03 < locked


def test_untextured_ground_stays():
    start = 3.0 + 0.01 * torch.arange(WIDTH).float().expand(LINES, WIDTH)
    left, right = (100 + 0.5 * torch.randn(LINES, WIDTH) for _ in "ab")
    refined = refine(left, right, start)
    assert (refined - start)[INSIDE].abs().mean() < 0.25  # as little as matching itself knows
    flat = torch.full((LINES, WIDTH), 100.0)
    torch.testing.assert_close(refine(flat, flat, start)[INSIDE], start[INSIDE])


def test_missing_stays_missing_and_pulls_nothing():
    shift = 2.4
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(shift))
    start = torch.full((LINES, WIDTH), 2.0)
    start[20:40, 100:140] = torch.nan
    refined = refine(left, right, start)
    assert torch.equal(refined.isnan(), start.isnan())
    assert (refined - shift)[INSIDE].abs().nan_to_num().mean() < 0.01
    around = (slice(12, 48), slice(92, 148))
    assert (refined - shift)[around].abs().nan_to_num().max() < 0.1
    assert refine(left, right, torch.full_like(start, torch.nan)).isnan().all()


def test_brightness_offset_changes_nothing():
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(1.3))
    start = torch.ones(LINES, WIDTH)
    refined = refine(left, right, start)
    torch.testing.assert_close(refine(left + 30, right - 20, start), refined, rtol=0, atol=1e-3)


def test_a_factor_of_brightness_changes_little_where_it_is_an_unknown():
    left, right = texture(torch.tensor(0.0), 0.5), texture(torch.tensor(1.3), 0.5)
    start = torch.ones(LINES, WIDTH)
    with_gain = dataclasses.replace(REFINE, with_gain=True)
    darker = 0.7 * right + 12.0
    error, without = ((refine(left, darker, start, options) - 1.3)[INSIDE] for options in (with_gain, REFINE))
    equal = (refine(left, right, start) - 1.3)[INSIDE]
    assert error.square().mean().sqrt() < 1.5 * equal.square().mean().sqrt() < without.square().mean().sqrt()
    assert abs(error.mean()) < 0.005


def test_sigma_covers_ground_that_no_plane_fits():
    """A ripple of 18 px is smoothed by a window of 9: an error that no residual of white noise predicts."""
    v, u = torch.meshgrid(torch.arange(LINES).float(), torch.arange(WIDTH).float(), indexing="ij")
    truth = 3.0 + 0.5 * torch.sin(2 * math.pi * u / 18) * torch.sin(2 * math.pi * v / 18)
    left, right = texture(-truth, 0.5), texture(torch.tensor(0.0), 0.5)
    refined = refine_disparity(left, right, torch.full((LINES, WIDTH), 3.0), REFINE)
    residual = left - warp_cubic(right, refined.disparity)
    windows = Windows.over(truth == truth, 9)
    equations = LeftWindows.of(left, windows, 0.5, with_gain=False)
    alone = equations.certainty(residual, equations.fit(residual)).sigma
    error = (refined.disparity - truth)[INSIDE].abs().median() / 0.6745
    assert 0.7 < error / refined.sigma[INSIDE].median() < 1.3
    assert error > 2 * alone[INSIDE].median()


def test_a_match_that_explains_little_must_be_more_certain():
    left, right, other = (texture(torch.tensor(shift), 0.5) for shift in (0.0, 1.0, 77.0))
    right[:, 120:] = other[:, 120:]
    options = dataclasses.replace(REFINE, largest_sigma_px=0.2)
    kept = refine(left, right, torch.ones(LINES, WIDTH), options).isfinite()
    assert kept[8:-8, 8:110].all()
    assert kept[8:-8, 130:-8].float().mean() < 0.05


def test_a_large_change_is_undone():
    left, right = texture(torch.tensor(0.0)), texture(torch.tensor(0.9))
    start = torch.zeros(LINES, WIDTH)
    refined = refine(left, right, start, RefineOptions(window=9, iterations=4, noise=1.0, largest_change_px=0.3))
    assert (refined[INSIDE] == 0).float().mean() > 0.95


def test_blocks_of_pixels_are_refined_by_all_their_pixels():
    slope = 4.0 / WIDTH
    truth = (torch.arange(WIDTH).float() * slope).expand(LINES, WIDTH)
    left, right = texture(-truth, 0.5), texture(torch.tensor(0.0), 0.5)
    start = truth[::2, ::2].round()
    for lines, width in ((LINES, WIDTH), (LINES - 1, WIDTH - 1)):
        refined = refine(left[:lines, :width], right[:lines, :width], start)
        assert refined.shape == (lines, width)
        error = (refined - truth[:lines, :width])[INSIDE]
        assert error.square().mean().sqrt() < 0.05
        assert abs(error.mean()) < 0.005
    with pytest.raises(ValueError, match="2 x 2"):
        refine(left, right, start[1:])


@pytest.mark.parametrize("block", [1, 2])
def test_a_part_of_the_left_image_finds_its_partners_in_the_whole_right_one(block):
    left, right = texture(torch.tensor(0.0), 0.5), texture(torch.tensor(7.3), 0.5)
    start = torch.full((LINES, WIDTH), 7.0)[::block, ::block]
    first = 80
    part = refine(left[:, first:160], right, start[:, first // block : 160 // block], first_column=first)
    whole = refine(left, right, start)[:, first:160]
    margin = 20
    torch.testing.assert_close(part[:, margin:-margin], whole[:, margin:-margin], rtol=0, atol=1e-4)
