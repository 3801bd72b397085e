"""The product frame: its formulas against the matrix form, their inverses and derivatives, and its heights."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsvision.estimation import jacobian
from lsvision.geometry import (
    ProductFrame,
    aligned_rotation,
    displace,
    line_at,
    middle_point,
    motion_sigma,
    product_axes,
    project,
    scan_position,
    to_product,
    travel_at,
    zero_disparity_mm,
)
from lsvision.types import Rig, Travel

RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
PITCH = 0.07
LINES = 400
LOG = (torch.arange(LINES) * PITCH + 0.03 * torch.sin(torch.arange(LINES) / 9.0)).double()
TRAVELS = {
    "constant": Travel(PITCH),
    "reverse": Travel(PITCH, None, "reverse"),
    "encoder": Travel(PITCH, LOG),
    "reverse encoder": Travel(PITCH, LOG, "reverse"),
}


def skewed(angle_x_deg: float, angle_z_deg: float, stretch: float) -> torch.Tensor:
    """A motion turned sideways and in depth, of a given stretch."""
    x, z = math.tan(math.radians(angle_x_deg)), math.tan(math.radians(angle_z_deg))
    n = torch.tensor([x, 1.0, z], dtype=torch.float64)
    return stretch * n / torch.linalg.vector_norm(n)


def frame_of(travel: str = "constant", n: torch.Tensor | None = None) -> ProductFrame:
    return ProductFrame(RIG, TRAVELS[travel], skewed(2.0, -1.5, 1.0246) if n is None else n)


def samples(count: int = 500) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Columns, lines and depths all over a scan."""
    column, line, depth = torch.rand(3, count, dtype=torch.float64)
    return column * (RIG.width_px - 1), line * (LINES - 1), zero_disparity_mm(RIG) - 60 + 120 * depth


def test_batch_equals_loop() -> None:
    frame, (column, line, z) = frame_of(), samples(20)
    whole = frame.position(column, line, z)
    assert whole.shape == (20, 3)
    for i in range(20):
        assert torch.equal(frame.position(column[i], line[i], z[i]), whole[i])


def test_nominal_motion_by_hand() -> None:
    frame = frame_of(n=torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    z0, f = zero_disparity_mm(RIG), 11384.0
    column, line, z = (torch.tensor(value, dtype=torch.float64) for value in (1042.0 + f / 4, 100.0, z0 - 10))
    expected = torch.tensor([(z0 - 10) / 4, 7.0, z0 - 10], dtype=torch.float64)
    torch.testing.assert_close(frame.position(column, line, z), expected, rtol=0, atol=1e-10)
    assert frame.height_datum_mm == pytest.approx(z0, abs=1e-12)
    assert frame.height_over_relief_mm == 0.0
    assert frame.advance_mm == pytest.approx(PITCH)


@pytest.mark.parametrize("travel", TRAVELS)
def test_equals_the_matrix_form(travel: str) -> None:
    """q = (e_x, e_y, e_z)ᵀ p with p = (x, 0, z) + y n, every sample by itself."""
    frame, (column, line, z) = frame_of(travel), samples()
    x = (column - RIG.principal_left_px) / RIG.focal_length_mm * RIG.pixel_pitch_um * 1e-3 * z
    p = displace(torch.stack([x, travel_at(frame.travel, line), z], dim=-1), frame.n)
    expected = torch.stack([product_axes(frame.n) @ point for point in p])
    q = frame.position(column, line, z)
    torch.testing.assert_close(q, expected, rtol=0, atol=1e-12)
    measured = torch.stack([x, travel_at(frame.travel, line), z], dim=-1)
    torch.testing.assert_close(to_product(measured, frame.n), expected, rtol=0, atol=1e-12)

    along, relief = frame.along(line), zero_disparity_mm(RIG) - q[:, 2]
    torch.testing.assert_close(frame.q_y(along, q[:, 0], relief), expected[:, 1], rtol=0, atol=1e-11)
    torch.testing.assert_close(frame.depth(column, relief), z, rtol=0, atol=1e-10)


@pytest.mark.parametrize("travel", TRAVELS)
def test_round_trip(travel: str) -> None:
    frame, (column, line, z) = frame_of(travel), samples()
    source = frame.source(frame.position(column, line, z))
    torch.testing.assert_close(source[:, 0], column, rtol=0, atol=1e-7)
    torch.testing.assert_close(source[:, 1], line, rtol=0, atol=1e-8)
    torch.testing.assert_close(source[:, 2], z, rtol=0, atol=1e-9)
    torch.testing.assert_close(frame.line(frame.along(line)), line, rtol=0, atol=1e-9)


def test_derivatives() -> None:
    """Along its ray a sample moves by ``ray`` per mm of depth, with the line by the advance along e_y."""
    frame = frame_of()
    column, line, z = (torch.tensor([value], dtype=torch.float64) for value in (3000.0, 50.0, 790.0))
    by_column = jacobian(lambda at: frame.position(at, line, z)[0], column)[:, 0]
    by_line = jacobian(lambda at: frame.position(column, at, z)[0], line)[:, 0]
    by_depth = jacobian(lambda at: frame.position(column, line, at)[0], z)[:, 0]
    torch.testing.assert_close(by_depth, frame.ray(column)[0], rtol=0, atol=1e-12)
    # torch's forward mode rounds Python's scalars, here the line pitch, to single precision.
    along = torch.tensor([0.0, frame.advance_mm, 0.0], dtype=torch.float64)
    torch.testing.assert_close(by_line, along, rtol=1e-7, atol=1e-12)
    inverse = jacobian(frame.source, frame.position(column, line, z)[0])
    forward = torch.stack([by_column, by_line, by_depth], dim=-1)
    torch.testing.assert_close(inverse @ forward, torch.eye(3).double(), rtol=0, atol=1e-6)


def test_offset_range_holds_every_sample() -> None:
    frame, (column, line, z) = frame_of(), samples(5000)
    q = frame.position(column, line, z)
    ends = q[:, 0].aminmax()
    depths = torch.stack(z.aminmax())
    low, high = frame.offset_range(torch.stack(ends), depths)
    offset = q[:, 1] - frame.along(line)
    assert low <= offset.min() + 1e-9
    assert offset.max() - 1e-9 <= high
    field = frame.field(depths)
    assert field[..., 0].min() <= q[:, 0].min()
    assert q[:, 0].max() <= field[..., 0].max()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.9, 1.1), st.floats(-60, 60), st.floats(0, 5000))
def test_heights_are_those_above_the_middle_of_zero_disparity(
    angle_x: float, angle_z: float, stretch: float, height: float, travelled: float
) -> None:
    """A surface that runs along the motion ``height`` before c has that height at every line and any motion."""
    frame = frame_of(n=skewed(angle_x, angle_z, stretch))
    runs_along = middle_point(RIG) + travelled * frame.n - height * product_axes(frame.n)[2]
    x, y, z = scan_position(runs_along, frame.n)
    column, _ = project(RIG, x, z)
    q = frame.position(column, line_at(frame.travel, y), z)
    assert float(frame.height_datum_mm - q[2]) == pytest.approx(height, abs=1e-9)
    relief = zero_disparity_mm(RIG) - q[2]
    assert float(relief + frame.height_over_relief_mm) == pytest.approx(height, abs=1e-9)


def test_a_shifted_sensor_line_sees_the_same_point() -> None:
    frame, shift = frame_of(), torch.tensor(0.28, dtype=torch.float64)
    column, line, z = samples(50)
    # The point at (x, 0, z) on ``line`` has moved by shift / n2 of travel when it crosses the plane Y = shift.
    x = (column - RIG.principal_left_px) / 11384.0 * z
    moved = torch.stack([x, torch.zeros_like(x), z], dim=-1) - frame.n * (-shift / frame.n[1])
    expected, _ = project(RIG, moved[:, 0], moved[:, 2])
    torch.testing.assert_close(frame.shifted_column(column, z, shift), expected, rtol=0, atol=1e-8)
    later = frame.shifted_line(line, -shift)
    travelled = travel_at(frame.travel, later) - travel_at(frame.travel, line)
    torch.testing.assert_close(travelled, (shift / frame.n[1]).expand_as(line), rtol=0, atol=1e-12)


def test_a_sensor_line_beside_looks_along_a_plane_through_the_centre_of_the_camera() -> None:
    """Y = shift z / z0, at the depth at which the point is seen: it moves in depth until then."""
    frame, shift = frame_of(), torch.tensor([-0.28, 0.28, 1.4], dtype=torch.float64)[:, None]
    _, _, z = samples(50)
    y = frame.plane_y(shift, z)
    seen_at = z + y * frame.n[2] / frame.n[1]
    torch.testing.assert_close(y / seen_at, (shift / zero_disparity_mm(RIG)).expand_as(y), rtol=1e-12, atol=0)
    z0 = zero_disparity_mm(RIG)
    assert float(frame_of(n=skewed(0.0, 0.0, 1.0)).plane_y(shift[1], z.new_tensor(z0 + 10.0))) == pytest.approx(
        0.28 * (1 + 10.0 / z0)
    )


def test_motion_sigma_is_the_root_of_the_rotated_covariance() -> None:
    n, root = skewed(2.0, -1.5, 1.02), torch.randn(3, 3, dtype=torch.float64)
    drawn = torch.randn(200_000, 3, dtype=torch.float64) @ root.mT @ product_axes(n).mT
    torch.testing.assert_close(motion_sigma(n, root @ root.mT), drawn.std(0), rtol=0.01, atol=0)
    torch.testing.assert_close(aligned_rotation(n) @ product_axes(n), torch.eye(3).double())
