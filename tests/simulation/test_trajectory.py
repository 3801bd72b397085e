"""Rays and projection are inverse to each other under any motion."""

import dataclasses
import math

import pytest
import torch

from lsvision.geometry import project
from lsvision.simulation import EncoderConfig, MotionConfig, Trajectory
from lsvision.simulation.trajectory import cast_rays

SHAKEN = MotionConfig(-1.5, 0.8, 1.0246, vibration_x_mm=0.7, vibration_z_mm=0.4, vibration_roll_deg=0.3)


@pytest.fixture
def trajectory(small_rig):
    return Trajectory(small_rig, SHAKEN, EncoderConfig(enabled=True), 0.56)


def test_n_has_the_stretch_and_angles(trajectory):
    n = trajectory.n
    torch.testing.assert_close(float(torch.linalg.vector_norm(n)), 1.0246)
    torch.testing.assert_close(math.degrees(math.atan2(n[0], n[1])), -1.5)
    torch.testing.assert_close(math.degrees(math.atan2(n[2], n[1])), 0.8)


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_position_and_line_are_inverse(trajectory, transport):
    trajectory = dataclasses.replace(trajectory, transport=transport)
    line = torch.linspace(-20.0, 2000.0, 401, dtype=torch.float64)
    position = trajectory.position(line)
    assert ((position.diff() > 0) == (transport == "forward")).all()
    torch.testing.assert_close(trajectory.line_at(position), line, rtol=0, atol=1e-9)


def test_vibration_has_its_rms_and_no_mean(trajectory):
    line = torch.arange(0, 2_000_000, 7, dtype=torch.float64)
    vibration = trajectory.vibration(line)
    expected = torch.tensor([0.7, 0.4, math.radians(0.3)], dtype=torch.float64)
    torch.testing.assert_close(vibration.std(0), expected, rtol=0.01, atol=0)
    assert (vibration.mean(0).abs() < 0.01 * expected).all()


def test_still_motion_is_equation_11(small_rig):
    trajectory = Trajectory(small_rig, MotionConfig(-1.5, 0.8, 1.0246), EncoderConfig(), 0.56)
    measured = torch.tensor([[20.0, 100.0, 800.0]], dtype=torch.float64)  # x, line, z
    n = trajectory.n
    point = torch.tensor([[20.0, 0.0, 800.0]], dtype=torch.float64) + 56.0 * n
    torch.testing.assert_close(trajectory.project(point), measured, rtol=0, atol=1e-10)


@pytest.mark.parametrize("transport", ["forward", "reverse"])
@pytest.mark.parametrize("camera", ["left", "right"])
def test_rays_pass_through_the_points_that_project_onto_them(trajectory, small_rig, camera, transport):
    trajectory = dataclasses.replace(trajectory, transport=transport)
    points = torch.randn(60, 3, dtype=torch.float64) * 30 + torch.tensor([170.0, 120.0, 790.0])
    x, line, z = trajectory.project(points).unbind(-1)
    columns = project(small_rig, x, z)[camera == "right"]
    rays = cast_rays(trajectory, camera, columns, line)
    seen = rays.origin + z[:, None] * (rays.slope.double()[:, None] * rays.across + rays.ahead)
    torch.testing.assert_close(seen, points, rtol=0, atol=5e-5)  # mm; the slope is float32


def test_displacement_adds_to_what_the_cameras_see(small_rig):
    """A point on the axis of roll is seen shifted by (dx, dz)."""
    trajectory = Trajectory(small_rig, SHAKEN, EncoderConfig(), 0.56)
    y = torch.tensor([80.0], dtype=torch.float64)
    x, line, z = trajectory.project(trajectory.pivot + y[:, None] * trajectory.n).unbind(-1)
    dx, dz, _ = trajectory.vibration(line).unbind(-1)
    torch.testing.assert_close(torch.stack([x, z]), trajectory.pivot[[0, 2], None] + torch.stack([dx, dz]))


def test_roll_turns_from_x_towards_negative_z_seen_with_y_into_the_page(small_rig):
    motion = MotionConfig(vibration_roll_deg=1.0)
    trajectory = Trajectory(small_rig, motion, EncoderConfig(), 0.56)
    y = torch.tensor([80.0], dtype=torch.float64)
    beside = trajectory.pivot + torch.tensor([10.0, 0.0, 0.0]) + y[:, None] * trajectory.n
    x, line, z = trajectory.project(beside).unbind(-1)
    roll = trajectory.vibration(line)[:, 2]
    torch.testing.assert_close(x - trajectory.pivot[0], 10 * torch.cos(roll))
    torch.testing.assert_close(z - trajectory.pivot[2], -10 * torch.sin(roll))
