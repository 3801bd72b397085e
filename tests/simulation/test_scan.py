"""Whole scans: strips, seeds, transport, colour lines, depth, logs, formats and bad settings."""

import dataclasses
import json

import pytest
import torch

from lsvision.errors import ConfigError
from lsvision.geometry import (
    aligned_rotation,
    focal_length_px,
    line_at,
    travel_at,
    triangulate,
    zero_disparity_mm,
)
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    artwork,
    simulate,
)
from lsvision.simulation.rail import corrugation_mm, crown_place
from lsvision.simulation.trajectory import cast_rays
from tests.combinations import crossed
from tests.simulation.corner_fit import fit_corners

SCENES = [SceneConfig(yaw_deg=10.0, pitch_deg=5.0), SceneConfig("sheet", roll_deg=3.0), SceneConfig("rail")]


PITCH = 1.12


def _kind(scene):
    return scene.kind


@pytest.mark.parametrize("scene", SCENES, ids=_kind)
def test_strips_of_any_height_hold_the_same_bits(coarse, board, motion, scene):
    simulation = simulate(coarse, board, scene, motion, SensorConfig(), Acquisition(PITCH, lines=70))
    for camera in ("left", "right"):
        whole = torch.cat(list(simulation.strips(camera, 70)))
        assert whole.shape == (70, coarse.width_px, 3)
        assert whole.dtype == torch.uint8
        for height in (1, 7, 64, 1000):
            strips = list(simulation.strips(camera, height))
            assert all(len(strip) == height for strip in strips[:-1])
            assert torch.equal(torch.cat(strips), whole)
    depth = torch.cat(list(simulation.depth_strips(70)))
    assert torch.equal(torch.cat(list(simulation.depth_strips(41))), depth)


@pytest.mark.parametrize("scene", SCENES, ids=_kind)
def test_blocks_meet_without_a_seam(coarse, board, motion, clean, whole, scene, monkeypatch):
    simulation = simulate(coarse, board, scene, motion, clean, Acquisition(PITCH, lines=96))
    by_default = whole(simulation)
    monkeypatch.setattr("lsvision.simulation.scan._BLOCK", 48)
    assert (whole(simulation) - by_default).abs().max() < 0.05 * 257  # a twentieth of a grey value of 255


def test_seeds_change_only_what_they_name(coarse, board, motion, whole):
    base = simulate(coarse, board, SceneConfig(), motion, SensorConfig(), Acquisition(PITCH, lines=64))
    again = simulate(coarse, board, SceneConfig(), motion, SensorConfig(), Acquisition(PITCH, lines=64))
    noise = simulate(coarse, board, SceneConfig(), motion, SensorConfig(seed=1), Acquisition(PITCH, lines=64))
    texture = simulate(coarse, board, SceneConfig(seed=1), motion, SensorConfig(), Acquisition(PITCH, lines=64))
    assert torch.equal(whole(base), whole(again))
    difference = whole(base) - whole(noise)
    assert abs(difference.std() - 2**0.5 * 1.5) < 0.1  # of two draws of the default noise, quantised
    assert abs(difference.mean()) < 0.05
    assert not torch.equal(whole(base), whole(texture))
    blocks = whole(noise)[:32] - whole(base)[:32], whole(noise)[32:] - whole(base)[32:]
    assert not torch.equal(*blocks)


@pytest.mark.parametrize("scene", SCENES[:2], ids=_kind)
def test_reverse_transport_turns_the_image_upside_down(coarse, board, clean, motion, whole, scene):
    scene = dataclasses.replace(scene, conveyor_drop_mm=40.0)
    forward = simulate(coarse, board, scene, motion, clean, Acquisition(PITCH))
    reverse = simulate(coarse, board, scene, motion, clean, Acquisition(PITCH, transport="reverse"))
    # Inside the target: the endless conveyor shows other parts of its texture.
    covered = torch.cat(list(forward.depth_strips())) < zero_disparity_mm(coarse) + scene.conveyor_drop_mm - 3.0
    inside = -torch.nn.functional.max_pool2d(-covered[None].float(), 9, 1, 4)[0] > 0
    assert inside.sum() > 30_000
    assert (whole(reverse).flip(0) - whole(forward))[inside].abs().max() < 0.1 * 257
    height = torch.tensor([0.0, forward.lines - 1.0])
    for ours, theirs in zip(forward.corners(), reverse.corners(), strict=True):
        torch.testing.assert_close(theirs, (ours - height).abs())
    assert (travel_at(reverse.travel, torch.arange(3.0)) == torch.tensor([0.0, -PITCH, -2 * PITCH])).all()


def test_depth_agrees_with_triangulated_corners(coarse, board, clean):
    motion = MotionConfig(-1.5, 0.8, 1.0246, vibration_z_mm=0.4, vibration_x_mm=0.4, vibration_roll_deg=0.1)
    simulation = simulate(coarse, board, SceneConfig(pitch_deg=8.0, yaw_deg=30.0), motion, clean, Acquisition(PITCH))
    left, right = simulation.corners()
    _, z = triangulate(coarse, left[:, 0], left[:, 0] - right[:, 0])
    depth = torch.cat(list(simulation.depth_strips()))
    at = torch.nn.functional.grid_sample(
        depth[None, None].double(),
        2 * left[None, None] / (left.new_tensor([coarse.width_px, simulation.lines]) - 1) - 1,
        align_corners=True,
    ).flatten()
    torch.testing.assert_close(at, z, rtol=0, atol=0.01)


def test_rail_depth_is_its_profile_along_the_motion(coarse, board, clean):
    scene = SceneConfig("rail", defect_spacing_mm=0.0, roll_mark_period_mm=0.0)
    simulation = simulate(coarse, board, scene, MotionConfig(1.0, -2.0), clean, Acquisition(PITCH, lines=90))
    depth = torch.cat(list(simulation.depth_strips()))
    torch.testing.assert_close(depth[70], depth[5], rtol=0, atol=2e-3)  # nothing changes along a sound, still rail
    # The rise is a height, measured at right angles to the motion; within the scan plane it is longer.
    crown = zero_disparity_mm(coarse) - scene.rail_rise_mm / float(aligned_rotation(simulation.trajectory.n)[2, 2])
    torch.testing.assert_close(float(depth.min()), crown, rtol=0, atol=0.01)
    assert (depth.max() - depth.min()) < 52.0
    faulty = dataclasses.replace(scene, defect_spacing_mm=60.0)
    deeper = torch.cat(
        list(
            simulate(coarse, board, faulty, MotionConfig(1.0, -2.0), clean, Acquisition(PITCH, lines=90)).depth_strips()
        )
    )
    assert 0.2 < (deeper - depth).max() < 1.2
    assert (deeper - depth).min() > -1e-3


@pytest.mark.parametrize("angle_x_deg", [0.0, 3.0])
def test_corrugation_lifts_the_whole_profile_of_a_line(coarse, board, clean, angle_x_deg):
    sound = SceneConfig("rail", defect_spacing_mm=0.0, roll_mark_period_mm=0.0)
    wavy = dataclasses.replace(sound, corrugation_mm=0.2, corrugation_wavelength_mm=40.0)
    flat, risen = (
        simulate(coarse, board, scene, MotionConfig(angle_x_deg, 0.8), clean, Acquisition(PITCH, lines=150))
        for scene in (sound, wavy)
    )
    rise = torch.cat(list(flat.depth_strips())) - torch.cat(list(risen.depth_strips()))
    crown = int(torch.cat(list(flat.depth_strips()))[0].argmin())
    lines = torch.arange(150, dtype=torch.float64)
    rays = cast_rays(flat.trajectory, "left", torch.zeros(1), lines).in_frame(flat.pose)
    expected = corrugation_mm(wavy, crown_place(rays))
    assert expected.max() > 0.19
    assert expected.min() < -0.19
    torch.testing.assert_close(rise[:, crown].double(), expected, rtol=0, atol=2e-3)
    assert (rise[:, crown - 8 : crown + 9] - rise[:, [crown]]).abs().max() < 4e-3
    waves = torch.fft.rfft(rise[:, crown]).abs()[1:].argmax() + 1
    assert int(waves) == round(150 * PITCH / 40.0)


def _color_shifts(simulation, whole, board):
    """Shift, in columns and lines, of each colour's corners from the model of the middle one; (3, corners, 2)."""
    image, truth = whole(simulation), simulation.corners()[0]
    spacing = simulation.rig.color_spacing_lines
    late = 0.0 if simulation.sensor.color_registered else -simulation.trajectory.sign
    guesses = (truth + truth.new_tensor([0.0, late * s]) for s in spacing)
    return torch.stack([fit_corners(image[..., c], guess, board.inner) - truth for c, guess in enumerate(guesses)])


@crossed("transport fringe", ["forward", "reverse"], [(1.0, False), (1.0, True), (1.05, True)])
def test_colours_lie_where_their_sensor_lines_look(small_rig, board, clean, whole, transport, fringe):
    """Registered colours show no fringe in nominal motion, and 1 - 1/stretch of their spacing in a stretched one."""
    stretch, registered = fringe
    rig = dataclasses.replace(small_rig, color_spacing_lines=(-4.0, 0.0, 4.0))
    sensor = dataclasses.replace(clean, color_registered=registered)
    scene, motion = SceneConfig(board_texture=0.0), MotionConfig(stretch=stretch)
    simulation = simulate(rig, board, scene, motion, sensor, Acquisition(0.56, transport=transport))
    shift = _color_shifts(simulation, whole, board)
    # Colour s sees a point when it is still s / stretch lines short of the plane Y = 0; the camera shifts by s lines.
    per_line = simulation.trajectory.sign * (registered - 1.0 / stretch)
    expected = torch.zeros_like(shift)
    expected[..., 1] = per_line * torch.tensor(rig.color_spacing_lines)[:, None]
    torch.testing.assert_close(shift, expected, rtol=0, atol=0.01)


def test_sheet_shows_its_artwork(small_rig, board, whole):
    sensor = SensorConfig(noise=0.0, blur_px=0.0, bits=16)
    scene = SceneConfig("sheet", yaw_deg=8.0)
    simulation = simulate(small_rig, board, scene, MotionConfig(), sensor, Acquisition(0.56))
    points = torch.rand(4000, 2) * torch.tensor([300.0, 220.0]) + 30.0
    in_space = torch.cat([points, torch.zeros(4000, 1)], -1).double() @ simulation.pose.rotation.mT
    x, line, z = simulation.trajectory.project(in_space + simulation.pose.translation).unbind(-1)
    u = x / z * focal_length_px(small_rig) + small_rig.principal_left_px
    image = whole(simulation)
    grid = 2 * torch.stack([u, line], -1) / (u.new_tensor([small_rig.width_px, simulation.lines]) - 1) - 1
    seen = torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid[None, None], align_corners=True)[0, :, 0]
    printed = artwork(scene, points).T.double()
    assert torch.corrcoef(torch.stack([seen.flatten(), printed.flatten()]))[0, 1] > 0.85
    assert artwork(scene, torch.tensor([[-1.0, 5.0], [400.0, 5.0]])).isnan().all()
    assert artwork(scene, torch.rand(2, 5, 3)).shape == (2, 5, 3)


def test_encoder_log_follows_the_true_positions(coarse, board, clean):
    encoder = EncoderConfig(enabled=True, wobble_mm=0.5, noise_mm=0.01)
    simulation = simulate(coarse, board, SceneConfig(), MotionConfig(), clean, Acquisition(PITCH, encoder=encoder))
    line = torch.arange(simulation.lines, dtype=torch.float64)
    error = travel_at(simulation.travel, line) - simulation.trajectory.position(line)
    assert abs(error.std() - 0.01) < 0.002
    assert (simulation.trajectory.position(line) - PITCH * line).abs().max() > 0.5
    corners = simulation.corners()[0]
    nominal = line_at(simulation.travel, simulation.trajectory.position(corners[:, 1]))
    torch.testing.assert_close(nominal, corners[:, 1], rtol=0, atol=0.05)


def test_truth_is_plain_and_complete(coarse, board, motion, clean):
    simulation = simulate(coarse, board, SceneConfig(), motion, clean, Acquisition(PITCH))
    truth = json.loads(json.dumps(simulation.truth()))
    assert {"n", "stretch", "R", "T", "lines", "args", "corners_left_px", "corners_right_px"} == truth.keys()
    assert torch.tensor(truth["corners_left_px"]).shape == (88, 2)
    points = torch.tensor(truth["corners_left_px"])
    assert (points > 0).all()
    assert (points < torch.tensor([coarse.width_px, truth["lines"]])).all()
    rail = simulate(coarse, board, SceneConfig("rail"), motion, clean, Acquisition(PITCH)).truth()
    assert "corners_left_px" not in rail


@pytest.mark.parametrize("yaw", [0.0, 40.0, 95.0])
def test_target_lies_in_both_views(coarse, board, motion, clean, yaw):
    simulation = simulate(coarse, board, SceneConfig(yaw_deg=yaw, pitch_deg=9.0), motion, clean, Acquisition(PITCH))
    for corners in simulation.corners():
        assert (corners > 2).all()
        assert (corners < torch.tensor([coarse.width_px, simulation.lines]) - 3).all()


@pytest.mark.parametrize("scene", SCENES, ids=_kind)
def test_images_are_neither_black_nor_flat_nor_burnt(coarse, board, motion, scene):
    for camera in ("left", "right"):
        image = torch.cat(
            list(simulate(coarse, board, scene, motion, SensorConfig(), Acquisition(PITCH)).strips(camera))
        ).float()
        assert 25 < image.mean() < 180
        assert image.std() > 20
        assert (image == 255).float().mean() < 0.002
        rows = image.mean((0, 2))
        assert rows[:30].mean() < 1.3 * rows[-30:].mean()  # lit from both sides
        assert rows[-30:].mean() < 1.3 * rows[:30].mean()


def test_mono_and_16_bits(coarse, board, motion, whole):
    scene, sensor = SceneConfig(), SensorConfig(noise=0.0)
    color = whole(simulate(coarse, board, scene, motion, sensor, Acquisition(PITCH, lines=40)))
    mono = simulate(coarse, board, scene, motion, dataclasses.replace(sensor, mono=True), Acquisition(PITCH, lines=40))
    deep = simulate(coarse, board, scene, motion, dataclasses.replace(sensor, bits=16), Acquisition(PITCH, lines=40))
    assert (mono.channels, deep.channels) == (1, 3)
    assert (whole(mono)[..., 0] - color.mean(-1)).abs().max() <= 1.0
    assert next(deep.strips("left")).dtype == torch.uint16
    assert (whole(deep) / 257 - color).abs().max() <= 0.51


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SceneConfig("brick"), r"SceneConfig\.kind"),
        (lambda: SceneConfig("rail", yaw_deg=1.0), "yaw_deg"),
        (lambda: SceneConfig(texture_mm=0.0), r"SceneConfig\.texture_mm"),
        (lambda: SensorConfig(bits=12), r"SensorConfig\.bits"),
        (lambda: SensorConfig(supersampling=0), r"SensorConfig\.supersampling"),
        (lambda: SensorConfig(blur_px=-1.0), r"SensorConfig\.blur_px"),
        (lambda: MotionConfig(stretch=0.0), r"MotionConfig\.stretch"),
        (lambda: MotionConfig(vibration_wavelengths_mm=[]), "vibration_wavelengths_mm"),
        (lambda: Acquisition(float("nan")), r"Acquisition\.line_pitch_mm"),
        (lambda: Acquisition(PITCH, lines=0), r"Acquisition\.lines"),
    ],
)
def test_options_out_of_range_are_named(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"acquisition": Acquisition(PITCH, encoder=EncoderConfig(True, wobble_mm=60.0))}, r"encoder\.wobble_mm"),
    ],
)
def test_bad_settings_are_named(coarse, board, change, message):
    settings = {
        "scene": SceneConfig(),
        "motion": MotionConfig(),
        "sensor": SensorConfig(),
        "acquisition": Acquisition(PITCH),
    }
    with pytest.raises(ConfigError, match=message):
        simulate(coarse, board, **(settings | change))


def test_strip_height_must_be_positive(coarse, board, motion):
    with pytest.raises(ValueError, match="strip_lines"):
        simulate(coarse, board, SceneConfig(), motion, SensorConfig(), Acquisition(PITCH)).strips("left", 0)
