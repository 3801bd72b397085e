"""Columns that respond unevenly, and the references that show how."""

from dataclasses import replace

import pytest
import torch

from lsvision.errors import ConfigError
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate

UNEVEN = SensorConfig(vignetting=0.4, gain_noise=0.05, offset=4.0, offset_noise=1.0, supersampling=2)
FAST = Acquisition(0.56, lines=64)


def test_codes_are_gain_times_the_even_ones_plus_offset(small_rig, board, motion, whole):
    sensor = replace(UNEVEN, noise=0.0, bits=16)
    scene = SceneConfig("sheet")
    uneven, even = (
        simulate(small_rig, board, scene, motion, item, FAST)
        for item in (sensor, SensorConfig(noise=0.0, bits=16, supersampling=2))
    )
    for camera in ("left", "right"):
        response = uneven.response(camera)
        assert response.shape == (small_rig.width_px, 3)
        raw, expected = whole(uneven, camera), whole(even, camera) * response.gain + response.offset
        inside = expected < 65535
        assert float((raw - expected)[inside].abs().max()) <= 1.5  # both are rounded
    gains = [uneven.response(camera).gain for camera in ("left", "right")]
    assert not torch.equal(*gains)
    middle = small_rig.width_px // 2
    assert float(gains[0][:50].mean() / gains[0][middle - 50 : middle + 50].mean()) == pytest.approx(0.63, abs=0.03)


def test_strips_of_any_height_hold_the_same_bits(small_rig, board, motion):
    simulation = simulate(small_rig, board, SceneConfig("white"), motion, UNEVEN, FAST)
    whole = torch.cat(list(simulation.strips("left", 64)))
    assert torch.equal(torch.cat(list(simulation.strips("left", 7))), whole)


def test_a_dark_scan_has_its_offsets_and_noise_alone(small_rig, board, motion, whole):
    simulation = simulate(small_rig, board, SceneConfig("dark"), motion, UNEVEN, FAST)
    image = whole(simulation)
    off = image.mean(0) - simulation.response("left").offset
    assert float(off.square().mean().sqrt()) < 0.3
    assert float(image.std(0).mean()) == pytest.approx(1.5, abs=0.1)


def test_dirt_covers_its_share_of_a_white_that_moves(small_rig, board, whole):
    sensor, motion = SensorConfig(noise=0.0, supersampling=2), MotionConfig()
    clean, dirty = (
        whole(simulate(small_rig, board, SceneConfig("white", dirt_share=share), motion, sensor, FAST))[..., 1]
        for share in (0.0, 0.1)
    )
    assert float((dirty < 0.8 * clean).double().mean()) == pytest.approx(0.1, abs=0.05)
    here, later = ((dirty / clean)[lines] < 0.8 for lines in (slice(0, 1), slice(40, 41)))
    assert not torch.equal(here, later)
    depth = torch.cat(list(simulate(small_rig, board, SceneConfig("white"), motion, sensor, FAST).depth_strips()))
    assert float(depth.std()) < 0.01


@pytest.mark.parametrize(("option", "value"), [("vignetting", 1.0), ("gain_noise", 0.5), ("offset_noise", -1.0)])
def test_values_that_no_sensor_has(option, value):
    with pytest.raises(ConfigError, match=option):
        SensorConfig(**{option: value})


def test_a_reference_runs_along_the_motion():
    with pytest.raises(ConfigError, match="pitch_deg: expected 0, as a white runs along the motion"):
        SceneConfig("white", pitch_deg=2.0)
