"""Gains of columns by the sideways wander of objects."""

import functools
import math

import pytest
import torch
from torch import Tensor

from lsvision.errors import ResponseError
from lsvision.stages.response.archive import response_of_scans
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.wander import WanderGains, WanderSums, _without_long

WIDTH = 300


@functools.cache
def wandering(rms: float, lines: int = 6000, seed: int = 0) -> tuple[WanderGains, Tensor]:
    """What lines show of an object with streaks and edges that wanders by ``rms`` px, and the true gains."""
    chance = torch.Generator().manual_seed(seed)
    vignetting = 1 - 0.4 * torch.linspace(-1, 1, WIDTH)[:, None].square()
    gain = vignetting * (1 + 0.05 * torch.randn(WIDTH, 3, generator=chance))
    length = WIDTH + 200
    pattern = 0.5 * ((torch.arange(length) > 130) & (torch.arange(length) < 260)).double()
    for cell in (1, 3, 8, 30):
        streaks = torch.randn(length // cell + 3, generator=chance, dtype=torch.float64)
        pattern += 0.05 * streaks.repeat_interleave(cell)[:length]
    v = torch.arange(lines, dtype=torch.float64)
    wander = rms * (torch.sin(2 * math.pi * v / 310) + torch.sin(2 * math.pi * v / 130 + 1))
    sums = WanderSums()
    for number, part in enumerate(wander.split(250)):
        place = torch.arange(WIDTH) + 100 - part[:, None]
        base = place.floor().long()
        seen = torch.lerp(pattern[base], pattern[base + 1], place - base)
        seen = seen + 0.1 * torch.randn(seen.shape, generator=chance)
        codes = 90 * seen.exp()[..., None] * gain + 1.5 * torch.randn(*seen.shape, 3, generator=chance)
        sums.add(codes.round().clamp(0, 255), torch.ones(seen.shape, dtype=torch.bool), part, number)
    return sums.gains(), gain.double().log()


@pytest.mark.parametrize("rms", [3.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_fine_gains_come_back_within_one_percent_with_honest_sigma(rms):
    found, truth = wandering(rms)
    off = (found.log_gain - _without_long(truth, found.observed_px))[20:-20]
    error = float(off.square().mean().sqrt())
    assert error < 0.005
    assert 0.6 < error / found.sigma < 1.5
    assert float(_without_long(truth, found.observed_px)[20:-20].std()) > 0.045  # that much was there
    assert found.wander_px == pytest.approx(rms, rel=0.15)


def test_waves_that_are_observed_by_hand():
    """Of a wander that is uniform over ±5 px, φ = sin(5k) / 5k: 1 - φ² = 0.1 at 5k = 0.551."""

    def of(wander: Tensor) -> WanderGains:
        sums = WanderSums()
        sums.add(torch.ones(len(wander), 10, 1), torch.ones(len(wander), 10, dtype=torch.bool), wander, 0)
        return sums.gains()

    assert of(torch.arange(-10, 11) * 0.5).observed_px == pytest.approx(2 * math.pi * 5.24 / 0.551, rel=0.03)
    assert of(torch.zeros(1)).observed_px == 0.0


@pytest.mark.parametrize("rms", [0.0, 0.3])
def test_without_wander_an_archive_is_refused(rms):
    found, _ = wandering(rms, lines=500)
    with pytest.raises(ResponseError) as caught:
        response_of_scans({"a": found}, torch.zeros(WIDTH, 3), ResponseConfig())
    assert f"wander sideways by {found.wander_px:.2g} px rms at most, expected 1.5" in str(caught.value)


def test_scans_are_joined_by_their_sigma_and_those_that_keep_still_are_left_out():
    still, (one, _), (other, _) = wandering(0.0, lines=300)[0], wandering(4.0, 3000), wandering(4.0, 3000)
    joined = response_of_scans({"a": one, "b": still, "c": other}, torch.zeros(WIDTH, 3), ResponseConfig())
    assert joined.lines == (0, 2)
    assert torch.allclose(joined.gain, one.log_gain.exp())  # the same scan twice
    assert joined.relative_sigma == pytest.approx(one.sigma / math.sqrt(2), rel=1e-6)
    with pytest.raises(ResponseError, match=r"its gains are known to .*%, expected 0.01%"):
        response_of_scans({"a": one}, torch.zeros(WIDTH, 3), ResponseConfig(archive_sigma=1e-4))


def test_columns_that_no_line_shows_keep_their_gain():
    sums = WanderSums()
    seen = torch.ones(400, 50, dtype=torch.bool)
    seen[:, 40:] = False
    wander = 4 * torch.sin(torch.arange(400) / 30.0).double()
    sums.add(torch.full((400, 50, 1), 100.0), seen, wander, 0)
    sums.add(torch.full((400, 50, 1), 100.0), seen, wander, 4)
    found = sums.gains()
    assert bool(found.log_gain[40:].isnan().all())
    assert float(found.log_gain[:40].abs().max()) < 1e-6
