"""The response of a camera by a dark and a moving white reference, and references that cannot be used."""

from dataclasses import replace

import pytest
import torch

from lsvision.errors import ResponseError
from lsvision.stages.response.codes import clipped_mean, grouped_median
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.measured import evened
from lsvision.stages.response.references import Reference, measure_references
from lsvision.stages.response.still import shared_structure
from lsvision.types import TensorImage
from tests.stages.response.references import WIDTH, Made, make

CONFIG = ResponseConfig()


def measured(made: Made, config: ResponseConfig = CONFIG):
    return measure_references(Reference(made.dark, "dark"), Reference(made.white, "white"), config)


def test_a_grouped_median_resolves_parts_of_a_code_and_the_black_clamp():
    values = 6.3 + 1.5 * torch.randn(4000, 50)
    assert float((grouped_median(values.round()) - 6.3).abs().max()) < 0.12
    clamped = (0.4 + 1.5 * torch.randn(4000, 50)).round().clamp(min=0)
    assert float((grouped_median(clamped) - 0.4).abs().max()) < 0.15
    assert torch.equal(grouped_median(torch.full((9, 2), 7.0)), torch.full((2,), 7.0))


def test_a_clipped_mean_leaves_dirt_out():
    values = 100 + torch.randn(1000, 20)
    values[::10] -= 40
    assert float((clipped_mean(values, values.median(0).values, 3.0) - 100).abs().max()) < 0.2


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gain_and_offset_come_back_within_half_a_percent_whatever_the_dirt(seed):
    made = make(seed, dirt=0.05)
    found = measured(made)
    shading = found.gain / made.response.gain
    off = shading / shading.mean() - 1
    assert float(off.square().mean().sqrt()) < 0.003
    assert float(off.abs().quantile(0.99)) < 0.01
    assert float((found.offset - made.response.offset).square().mean().sqrt()) < 0.15


@pytest.mark.parametrize("noise", [0.7, 3.0])
def test_sigmas_cover_the_errors(noise):
    made = make(4, noise=noise)
    found = measured(made)
    shading = found.gain / made.response.gain
    off = (shading / shading.mean() - 1) / (found.gain_sigma / found.gain)
    assert 0.6 < float(off.square().mean().sqrt()) < 1.5
    pull = (found.offset - made.response.offset) / found.offset_sigma
    assert 0.3 < float(pull.square().mean().sqrt()) < 1.3


def test_a_lamp_that_flickers_does_not_matter():
    made = make()
    lamp = 1 + 0.1 * torch.sin(torch.arange(400) / 3.0)[:, None, None]
    made = replace(made, white=TensorImage((made.white.tensor * lamp).round().clamp(0, 255).to(torch.uint8)))
    shading = measured(made).gain / made.response.gain
    assert float((shading / shading.mean() - 1).square().mean().sqrt()) < 0.006


def test_columns_that_do_not_see_or_clip_are_named():
    made = make(level=150.0)
    white = made.white.tensor.clone()
    white[:, 17] = made.dark.tensor[:, 17]
    white[:, 30, 1] = 255
    found = measured(replace(made, white=TensorImage(white)), replace(CONFIG, largest_sigma=0.01))
    assert found.gain.isnan().any(-1).nonzero()[:, 0].tolist() == [17, 30]
    assert found.blind_columns == 2


def test_gains_of_both_cameras_are_relative_to_one_white():
    one, other = measured(make(0)), measured(make(1, level=90.0))
    even = evened({"left": one, "right": other})
    assert float(even["left"].gain.quantile(0.97)) == pytest.approx(1.0, abs=0.02)
    ratio = even["left"].gain.median() / even["right"].gain.median()
    assert float(ratio) == pytest.approx(2.0, rel=0.03)
    assert even["left"].relative_sigma == pytest.approx(one.relative_sigma)


def refusal(made: Made, config: ResponseConfig = CONFIG) -> str:
    with pytest.raises(ResponseError) as caught:
        measured(made, config)
    return str(caught.value)


def test_references_that_cannot_be_used_say_why():
    good = make()
    swapped = Made(good.white, good.dark, good.response)
    assert "dark: expected a dark image, got a median of" in refusal(swapped)
    dim = make(level=30.0)
    assert "no brighter than the dark reference" in refusal(Made(dim.white, dim.dark, dim.response))
    assert "white: empty: its median is" in refusal(make(level=4.0))
    assert "white: clipped: " in refusal(make(level=330.0))
    assert "expected at least 64 lines" in refusal(replace(good, white=TensorImage(good.white.tensor[:1])))
    narrow = replace(good, dark=TensorImage(good.dark.tensor[:, :-1]))
    assert f"dark: expected {WIDTH} columns of 3 x torch.uint8 as the white reference has, got 299" in refusal(narrow)
    patterned = good.white.tensor.float() * (0.6 + 0.4 * (torch.arange(400) // 40 % 2)[:, None, None])
    patterned[:, WIDTH // 2 :] = good.white.tensor[:, WIDTH // 2 :]
    board = replace(good, white=TensorImage(patterned.to(torch.uint8)))
    assert "white: textured: " in refusal(board) or "white: moves wrongly" in refusal(board)
    lit = good.dark.tensor + (20 * (torch.arange(400) % 100 < 50))[:, None, None].to(torch.uint8)
    assert "dark: textured: it varies by" in refusal(replace(good, dark=TensorImage(lit)))


def test_a_reference_that_stops_moving_is_refused():
    good, white = make(dirt=0.2), make(dirt=0.2).white.tensor.clone()
    white[250:] = white[250]
    assert "moves wrongly: its structure stands in its columns on lines" in refusal(
        replace(good, white=TensorImage(white))
    )


def test_what_stands_on_the_reference_is_seen_by_both_cameras():
    chance = torch.Generator().manual_seed(0)
    own = [1 + 0.05 * torch.randn(2000, 3, generator=chance) for _ in range(2)]
    dirt = 1 + 0.03 * torch.randn(2000, 1, generator=chance)
    assert shared_structure(*own) is None
    found = shared_structure(own[0] * dirt, own[1] * dirt.roll(-37, 0))
    assert found is not None
    assert found.disparity_px == 37
    assert found.rms == pytest.approx(0.03, rel=0.2)
