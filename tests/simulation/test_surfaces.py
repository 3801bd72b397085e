"""The parts of a rendered surface: plane geometry, filtered edges, light, defects and integration."""

import math

import pytest
import torch

from lsvision.geometry import focal_length_px, rotation_from_vector, zero_disparity_mm
from lsvision.simulation import EncoderConfig, MotionConfig, SceneConfig, SensorConfig, Trajectory
from lsvision.simulation.defects import defects
from lsvision.simulation.lighting import line_lights
from lsvision.simulation.noise import Nodes
from lsvision.simulation.plane import coverage, footprint, square_wave, view_plane
from lsvision.simulation.sensor import expose, halo_px, integrate, sample_offsets
from lsvision.simulation.trajectory import cast_rays
from lsvision.types import Pose

SHAKEN = MotionConfig(-1.5, 0.8, 1.0246, vibration_x_mm=0.7, vibration_z_mm=0.4, vibration_roll_deg=0.3)


@pytest.mark.parametrize("first_line", [0, 100_000])
def test_plane_view_equals_a_float64_intersection_however_far_the_scan_has_gone(full_rig, first_line):
    trajectory = Trajectory(full_rig, SHAKEN, EncoderConfig(), 0.07)
    lines = first_line + torch.arange(20, dtype=torch.float64)
    columns = torch.arange(0, 7142, 31, dtype=torch.float64)
    rays = cast_rays(trajectory, "left", columns, lines)
    turn = rotation_from_vector(torch.tensor([0.1, -0.08, 0.7], dtype=torch.float64))
    pose = Pose(turn, trajectory.pivot + trajectory.position(lines[10]) * trajectory.n)
    view = view_plane(rays, pose, 0.4)

    slope = (columns - full_rig.principal_left_px) / focal_length_px(full_rig)
    direction = rays.across[:, None] * (slope - rays.middle_slope)[:, None] + rays.ahead[:, None]
    normal = turn[:, 2]
    z = ((pose.translation - rays.origin) @ normal)[:, None] / (direction @ normal)
    point = (rays.origin[:, None] + z[..., None] * direction - pose.translation) @ turn
    assert (view.x - point[..., 0]).abs().max() < 7e-5  # mm: a thousandth of a pixel
    assert (view.y + view.base_y * 0.4 - point[..., 1]).abs().max() < 7e-5
    assert (view.z - z).abs().max() < 2e-4
    assert (view.scan_x - slope * z).abs().max() < 2e-4


def test_filtered_edges_equal_the_mean_over_a_box():
    x = torch.linspace(-3.0, 10.0, 261)
    box = torch.linspace(-0.5, 0.5, 2001) * 0.3
    around = x[:, None] + box
    wave = torch.where((around / 2.0).floor() % 2 == 0, 1.0, -1.0).mean(-1)
    torch.testing.assert_close(square_wave(x, 2.0, 0.3), wave, rtol=0, atol=2e-3)
    inside = ((around > -1.0) & (around < 4.0)).float().mean(-1)
    torch.testing.assert_close(coverage(x, -1.0, 4.0, 0.3), inside, rtol=0, atol=2e-3)


def test_footprint_is_the_side_of_a_turned_sample():
    j, i = torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="xy")
    cos, sin = math.cos(0.7), math.sin(0.7)
    assert footprint(0.2 * (cos * j - sin * i)) == pytest.approx(0.2)
    assert footprint(0.2 * cos * j - 0.1 * sin * i) == pytest.approx(math.hypot(0.2 * cos, 0.1 * sin))


def test_light_is_one_in_the_middle_symmetric_and_falls_off(small_rig):
    lighting, middle = line_lights(small_rig), small_rig.baseline_mm / 2
    aside = torch.linspace(-250.0, 250.0, 101)
    z = torch.full_like(aside, zero_disparity_mm(small_rig))
    light = lighting.irradiance(middle + aside, z, 0.0, -1.0)
    torch.testing.assert_close(light[50], torch.tensor(1.0), rtol=0, atol=1e-5)
    torch.testing.assert_close(light, light.flip(0), rtol=0, atol=1e-5)
    assert (light[50:].diff() < 0).all()
    assert light[0] > 0.6
    left_flank = lighting.irradiance(torch.tensor([middle]), z[:1], -1.0, 0.0)
    expected = (150 / (150**2 + 400**2)) / (800 / (150**2 + 400**2))
    torch.testing.assert_close(float(left_flank), expected, rtol=1e-4, atol=0)
    assert lighting.irradiance(torch.tensor([middle]), z[:1], 0.0, 1.0) == 0  # turned away


def test_defects_are_the_same_in_any_piece_and_return_with_the_roll():
    scene = SceneConfig("rail", defect_spacing_mm=80.0, roll_mark_period_mm=50.0)
    whole = defects(scene, Nodes(-80, 0, 160, 1000, 0.4), 3)
    piece = defects(scene, Nodes(-20, 300, 60, 200, 0.4), 3)
    torch.testing.assert_close(piece.depth_mm, whole.depth_mm[300:500, 60:120])
    torch.testing.assert_close(piece.factor, whole.factor[300:500, 60:120])
    marks = SceneConfig("rail", defect_spacing_mm=0.0, roll_mark_period_mm=50.0)
    relief = defects(marks, Nodes(-80, 0, 160, 1000, 0.4), 3)
    torch.testing.assert_close(relief.depth_mm[:250], relief.depth_mm[250:500])
    assert 0.3 < relief.depth_mm.max() < 0.5
    assert relief.factor.min() > 0
    sound = SceneConfig("rail", defect_spacing_mm=0.0, roll_mark_period_mm=0.0)
    relief = defects(sound, Nodes(0, 0, 4, 4, 0.4), 0)
    assert (relief.depth_mm == 0).all()
    assert (relief.factor == 1).all()


def test_samples_tile_their_pixels():
    offsets = sample_offsets(-1, 3, SensorConfig(supersampling=2))
    torch.testing.assert_close(offsets.tolist(), [-1.25, -0.75, -0.25, 0.25, 0.75, 1.25])


@pytest.mark.parametrize("blur_px", [0.0, 0.6, 1.1])
def test_integration_keeps_light_and_has_the_variance_of_box_and_blur(blur_px):
    sensor = SensorConfig(blur_px=blur_px, supersampling=5)
    reach = halo_px(sensor)
    count = 15 + 2 * reach
    flat = integrate(torch.full((3, count * 5, count * 5), 0.7), sensor)
    torch.testing.assert_close(flat, torch.full((3, 15, 15), 0.7))
    samples = torch.zeros(1, count * 5, count * 5)
    samples[0, (count // 2) * 5 + 2, (count // 2) * 5 + 2] = 1.0
    blurred = integrate(samples, sensor)[0]
    profile = blurred.sum(0) / blurred.sum()
    shift = torch.arange(15.0) - 7
    torch.testing.assert_close((profile * shift).sum(), torch.tensor(0.0), rtol=0, atol=1e-5)
    # Summed over pixels, the variance of a centred point is that of the blur, plus what the sampling of a box adds.
    assert (profile * shift**2).sum() == pytest.approx(blur_px**2 + (blur_px > 0) / 12, abs=0.1)


def test_exposure_is_seeded_clamped_and_quantised():
    light = torch.tensor([0.0, 0.5, 2.0]).expand(3, 1, 3)
    grey = expose(light, SensorConfig(noise=0.0, exposure=0.8), 0)
    assert grey[0, :, 0].tolist() == [0, 102, 255]
    noisy = expose(torch.full((3, 40, 50), 0.5), SensorConfig(noise=2.0), 5)
    assert torch.equal(noisy, expose(torch.full((3, 40, 50), 0.5), SensorConfig(noise=2.0), 5))
    assert abs(noisy.float().std() - 2.0) < 0.1
