"""What machines have besides: gloss, lights along the sensor line, a depth of field, a trigger that jitters."""

import math
from dataclasses import replace

import pytest
import torch

from lsvision.errors import ConfigError
from lsvision.geometry import line_at, travel_at, zero_disparity_mm
from lsvision.simulation import Acquisition, EncoderConfig, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.simulation.lighting import Facet, line_lights
from lsvision.simulation.sensor import halo_px, integrate, received
from lsvision.simulation.surfaces import Look

CLEAN = SensorConfig(noise=0.0, bits=16, supersampling=2, exposure=0.5)
SHORT = Acquisition(1.12, lines=32)


def test_lights_along_the_sensor_line_by_hand(full_rig):
    """Against a sum over the points of a light."""
    lighting = line_lights(full_rig, "along")
    middle, z0 = full_rig.baseline_mm / 2, zero_disparity_mm(full_rig)
    length = torch.linspace(-350.0, 350.0, 20001, dtype=torch.float64)

    def summed(x: float, z: float, angle: float) -> float:
        up, aside = z - (z0 - 400.0), middle + length - x
        distance = (aside.square() + 60.0**2 + up**2).sqrt()
        cosine = (aside * math.sin(angle) + up * math.cos(angle)).clamp(min=-torch.inf) / distance
        return float((cosine / distance.square()).sum())

    full = summed(middle, z0, 0.0)
    for x, z, angle in ((middle + 100.0, z0 + 10.0, 0.0), (middle - 180.0, z0 - 20.0, 0.3), (middle, z0, -0.7)):
        place = (torch.tensor([value], dtype=torch.float64) for value in (x, z))
        found = lighting.irradiance(*place, math.sin(angle), -math.cos(angle))
        assert float(found) == pytest.approx(summed(x, z, angle) / full, rel=1e-3)


def test_a_mirror_shows_a_light_where_the_angles_are_equal(full_rig):
    """Straight below the eye, which has one of the lights beside it above and the other 300 mm aside."""
    x, z = torch.tensor([full_rig.baseline_mm / 2 + 150.0]), torch.tensor([zero_disparity_mm(full_rig)])

    def seen(lights: str, angle: float) -> float:
        facet = Facet(x, z, math.sin(angle), -math.cos(angle))
        return float(line_lights(full_rig, lights).highlight(facet, float(x), 400.0))

    for angle in (0.0, -math.atan(300 / 400) / 2):
        assert seen("beside", angle) == pytest.approx(1.0, abs=0.01)
        assert seen("beside", angle + 0.1) < 0.2
    half = math.atan(60 / 400) / 2  # a light along the line lies 60 mm before it, for every x
    assert seen("along", 0.0) == pytest.approx(2 * math.cos(half) ** 400, rel=0.05)
    assert seen("along", -0.3) > seen("along", 0.0)  # its mirrored place lies on it, too, further away
    assert seen("along", 0.35) < 0.1 * seen("along", 0.0)  # beyond its end, 200 mm aside


@pytest.mark.parametrize("lights", ["beside", "along"])
def test_gloss_brightens_steel_at_other_places_for_each_camera(coarse, board, motion, whole, lights):
    scene = SceneConfig("rail", lights=lights, rail_texture=0.0, defect_spacing_mm=0.0, roll_mark_period_mm=0.0)
    shiny, matt = (
        simulate(coarse, board, item, motion, CLEAN, SHORT) for item in (replace(scene, rail_gloss=0.5), scene)
    )
    peaks = []
    for camera in ("left", "right"):
        added = (whole(shiny, camera) - whole(matt, camera)).mean((0, 2))
        assert float(added.min()) >= -1.0
        assert float(added.max()) > 1500  # of 65535
        peaks.append(int(added.argmax()))
    assert peaks[0] != peaks[1]


def test_defocus_blurs_by_depth():
    sensor = replace(CLEAN, defocus_px_per_mm=0.1, blur_px=0.5)
    reach, step = halo_px(sensor), sensor.supersampling
    size = (20 + 2 * reach) * step
    color = torch.zeros(3, size, size)
    color[..., size // 2 :] = 1.0
    for off, expected in ((0.0, 0.0), (10.0, 1.0), (-25.0, 2.5), (100.0, 3.0)):
        seen = Look(color, torch.full((size, size), 800.0 + off))
        found = received(seen, sensor, 800.0)
        assert found.shape == (3, 20, 20)
        assert float((found - integrate(color, sensor, expected)).abs().max()) < 0.012
    # The blur of each pixel is that of its own depth.
    slanted = Look(color, (800.0 + torch.linspace(0, 30, size))[:, None].expand(size, size).contiguous())
    steepness = received(slanted, sensor, 800.0)[0].diff(dim=1).amax(1)
    assert bool((steepness.diff() < 0).all())


def test_a_rail_in_focus_is_sharper_than_its_conveyor(coarse, board, motion, whole):
    sensor = replace(CLEAN, defocus_px_per_mm=0.05, focus_height_mm=22.0)
    scene = SceneConfig("rail")
    sharp, soft = (whole(simulate(coarse, board, scene, motion, item, SHORT)) for item in (CLEAN, sensor))
    rough = [(image.diff(dim=1).abs().mean((0, 2)))[[60, image.shape[1] // 2]] for image in (sharp, soft)]
    kept = rough[1] / rough[0]
    assert float(kept[0]) < 0.75
    assert float(kept[1]) > 0.9


def test_the_trigger_jitters_and_no_log_shows_it(coarse, board):
    motion, encoder = MotionConfig(), EncoderConfig(jitter=0.1)
    source = simulate(coarse, board, SceneConfig("sheet"), motion, CLEAN, Acquisition(1.12, lines=500, encoder=encoder))
    lines = torch.arange(500, dtype=torch.float64)
    true, trajectory = source.trajectory.position(lines), source.trajectory
    jitter = torch.tensor(source.truth()["jitter_mm"], dtype=torch.float64)
    assert float(jitter.square().mean().sqrt()) == pytest.approx(0.112, rel=0.05)
    assert torch.allclose(true, 1.12 * lines + jitter)
    assert source.travel.positions_mm is None
    assert torch.allclose(trajectory.line_at(trajectory.position(lines[:-1] + 0.3)), lines[:-1] + 0.3, atol=1e-3)
    logged = EncoderConfig(enabled=True, noise_mm=0.0, jitter=0.1)
    source = simulate(coarse, board, SceneConfig("sheet"), motion, CLEAN, Acquisition(1.12, lines=500, encoder=logged))
    off = source.trajectory.position(lines) - travel_at(source.travel, lines)
    assert torch.allclose(off, torch.tensor(source.truth()["jitter_mm"], dtype=torch.float64), atol=1e-9)
    assert float((line_at(source.travel, travel_at(source.travel, lines)) - lines).abs().max()) < 1e-6


@pytest.mark.parametrize(
    ("config", "options", "problem"),
    [
        (EncoderConfig, {"jitter": 0.5}, "jitter"),
        (SceneConfig, {"lights": "above"}, "lights: expected 'beside' or 'along'"),
        (SceneConfig, {"rail_gloss": -1.0}, "rail_gloss"),
        (SensorConfig, {"defocus_px_per_mm": -1.0}, "defocus_px_per_mm"),
    ],
)
def test_values_that_no_machine_has(config, options, problem):
    with pytest.raises(ConfigError, match=problem):
        config(**options)
