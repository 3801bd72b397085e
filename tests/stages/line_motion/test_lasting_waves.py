"""The trend of waves over an object that is as short as they are; a motion at random shows none."""

import math

import pytest
import torch

from lsvision.stages.line_motion.lasting_waves import trend_of_waves

LINES, PITCH_MM = 450, 0.6
ALONG = PITCH_MM * torch.arange(LINES).double()
ALL = torch.ones(LINES, dtype=torch.bool)
SIGMA = torch.tensor([0.02, 0.005]).double().expand(LINES, 2)


def waves(seed, lengths_mm=(238.0, 99.0, 62.5), rms_mm=0.5):
    """Sums of waves of random phases in two components."""
    generator = torch.Generator().manual_seed(seed)
    phase = 2 * math.pi * torch.rand(2, len(lengths_mm), generator=generator).double()
    turn = 2 * math.pi * ALONG[:, None, None] / torch.tensor(lengths_mm).double() + phase
    return rms_mm * math.sqrt(2 / len(lengths_mm)) * torch.sin(turn).sum(-1)


def level(values):
    """Without mean and trend, and the trend."""
    place = ALONG - ALONG.mean()
    slope = place @ (values - values.mean(0)) / place.square().sum()
    return values - values.mean(0) - place[:, None] * slope, slope


def seen(values, seed, memory=4.0):
    """With errors that neighbouring lines share."""
    generator = torch.Generator().manual_seed(1000 + seed)
    share, noise = math.exp(-1 / memory), torch.randn(LINES, 2, generator=generator).double()
    for line in range(1, LINES):
        noise[line] = share * noise[line - 1] + math.sqrt(1 - share**2) * noise[line]
    return level(values)[0] + level(SIGMA * noise)[0]


@pytest.mark.parametrize("seed", range(6))
def test_the_trend_of_waves_is_found(seed):
    values = waves(seed)
    found = trend_of_waves(ALONG, seen(values, seed), SIGMA, 4.0, ALL)
    assert found is not None
    assert found.waves == 3
    error = found.slope - level(values)[1]
    size = (ALONG - ALONG.mean()).square().mean().sqrt()  # rms displacement of a slope of one
    assert float(error[0].abs() * size) < 0.03
    assert (error.abs() < 3 * found.variance.sqrt()).all()


def test_errors_of_the_trend_are_no_larger_than_stated():
    ratios = []
    for seed in range(20, 28):
        values = waves(seed)
        found = trend_of_waves(ALONG, seen(values, seed), SIGMA, 4.0, ALL)
        ratios.append((found.slope - level(values)[1])[0] / found.variance[0].sqrt())
    # No edge is bent here, which a part of what is stated stands for.
    assert 0.1 < float(torch.stack(ratios).square().mean().sqrt()) < 1.0


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("length_mm", [30.0, 100.0])
def test_a_motion_at_random_says_nothing(seed, length_mm):
    generator = torch.Generator().manual_seed(seed)
    knots = ALONG[::10]
    scaled = math.sqrt(3) * (knots[:, None] - knots).abs() / length_mm
    root = torch.linalg.cholesky((1 + scaled) * torch.exp(-scaled) + 1e-9 * torch.eye(len(knots)))
    drawn = 0.4 * root @ torch.randn(len(knots), 2, generator=generator).double()
    values = torch.nn.functional.interpolate(drawn.T[None], size=LINES, mode="linear", align_corners=True)[0].T
    found = trend_of_waves(ALONG, seen(values, seed), SIGMA, 4.0, ALL)
    if found is not None:  # four waves happen to fit it: then they must be right
        assert (found.slope - level(values)[1])[0].abs() < 3 * found.variance[0].sqrt()
    assert found is None or length_mm == 100.0


@pytest.mark.parametrize("length_mm", [450.0, 700.0, 1500.0])
def test_a_wave_far_longer_than_the_object_is_not_told_from_a_line(length_mm):
    values = waves(0, lengths_mm=(length_mm, 62.5))
    found = trend_of_waves(ALONG, seen(values, 0), SIGMA, 4.0, ALL)
    assert found is None or (found.slope - level(values)[1])[0].abs() < 3 * found.variance[0].sqrt()


def test_a_still_object_and_one_of_few_lines_show_none():
    assert trend_of_waves(ALONG, seen(0 * waves(0), 0), SIGMA, 4.0, ALL) is None
    assert trend_of_waves(ALONG, seen(waves(0), 0), SIGMA, 4.0, ALONG < 10.0) is None
    assert trend_of_waves(ALONG, waves(0), 0 * SIGMA, 4.0, ALL) is None
