import math
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.func import vmap

from lsvision.geometry import (
    displace,
    from_product,
    line_at,
    product_axes,
    scan_position,
    to_product,
    travel_at,
)
from lsvision.types import Travel


def f64(values: Sequence[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


N = f64([-0.026, 1.0246, 0.031])
LOG = f64([1.0, 1.5, 2.5, 2.75])

small = st.floats(-0.06, 0.06)
motions = st.tuples(small, st.floats(0.8, 1.25), small).map(f64)
measured_points = st.tuples(st.floats(-300, 300), st.floats(-1e5, 1e5), st.floats(700, 900)).map(f64)


def points(*batch: int) -> torch.Tensor:
    scale = f64([250.0, 4e3, 25.0])
    return torch.randn(*batch, 3, dtype=torch.float64) * scale + f64([0.0, 0.0, 797.0])


@pytest.mark.parametrize("function", [displace, scan_position, to_product, from_product])
def test_batch_equals_loop(function) -> None:
    at, n = points(4, 1), N + 0.01 * torch.randn(5, 3, dtype=torch.float64)
    batched = function(at, n)
    assert batched.shape == (4, 5, 3)
    for i in range(4):
        for j in range(5):
            torch.testing.assert_close(batched[i, j], function(at[i, 0], n[j]), rtol=1e-13, atol=1e-11)
    torch.testing.assert_close(vmap(function, (None, 0))(at[0, 0], n), batched[0], rtol=1e-13, atol=1e-11)


def test_worked_example() -> None:
    n = f64([0.1, 2.0, -0.5])
    measured = f64([3.0, 10.0, 800.0])
    assert displace(measured, n).tolist() == [4.0, 20.0, 795.0]
    assert scan_position(f64([4.0, 20.0, 795.0]), n).tolist() == [3.0, 10.0, 800.0]


def test_nominal_motion_changes_nothing() -> None:
    nominal = f64([0.0, 1.0, 0.0])
    at = points(20)
    for function in (displace, scan_position, to_product, from_product):
        assert torch.equal(function(at, nominal), at)


@given(measured_points, motions)
def test_scan_position_inverts_displace(measured: torch.Tensor, n: torch.Tensor) -> None:
    torch.testing.assert_close(scan_position(displace(measured, n), n), measured, rtol=1e-14, atol=1e-9)


@given(measured_points, motions)
def test_from_product_inverts_to_product(measured: torch.Tensor, n: torch.Tensor) -> None:
    torch.testing.assert_close(from_product(to_product(measured, n), n), measured, rtol=1e-13, atol=1e-9)


@given(measured_points, motions)
def test_product_is_the_turned_object(measured: torch.Tensor, n: torch.Tensor) -> None:
    turned = product_axes(n) @ displace(measured, n)
    torch.testing.assert_close(to_product(measured, n), turned, rtol=1e-13, atol=1e-8)


@given(motions)
def test_product_axes_are_a_rotation_along_the_motion(n: torch.Tensor) -> None:
    axes = product_axes(n)
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).double(), rtol=0, atol=1e-15)
    assert float(torch.linalg.det(axes)) == pytest.approx(1.0)
    torch.testing.assert_close(axes @ n, f64([0.0, float(n.norm()), 0.0]), rtol=0, atol=1e-15)
    assert float(axes[0, 0]) > 0.9
    assert float(axes[2, 2]) > 0.9
    assert float(axes[2].cross(f64([0.0, 0.0, 1.0]), dim=0) @ n) == pytest.approx(0.0, abs=1e-15)


def test_q_x_and_q_z_do_not_depend_on_travel() -> None:
    at = points(50)
    far = at + f64([0.0, 7e4, 0.0])
    near_q, far_q = to_product(at, N), to_product(far, N)
    assert torch.equal(near_q[:, 0], far_q[:, 0])
    assert torch.equal(near_q[:, 2], far_q[:, 2])
    torch.testing.assert_close(far_q[:, 1] - near_q[:, 1], (7e4 * N.norm()).expand(50), rtol=1e-14, atol=0)


def test_lines_are_skewed_by_the_angle_of_the_motion() -> None:
    n = f64([math.sin(math.radians(3)), math.cos(math.radians(3)), 0.0])
    ends = f64([[0.0, 0.0, 797.0], [500.0, 0.0, 797.0]])
    q = to_product(ends, n)
    assert float(q[1, 1] - q[0, 1]) == pytest.approx(26.2, abs=0.05)
    assert float(q[1, 1] - q[0, 1]) / 0.07 == pytest.approx(374, abs=1)


def test_distances_on_the_object_are_kept() -> None:
    at = points(6)
    torch.testing.assert_close(
        torch.cdist(to_product(at, N), to_product(at, N)), torch.cdist(displace(at, N), displace(at, N))
    )


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_travel_by_pitch(transport: str) -> None:
    travel, sign = Travel(0.07, None, transport), -1.0 if transport == "reverse" else 1.0
    lines = f64([[-3.0, 0.0], [0.5, 1e6]])
    torch.testing.assert_close(travel_at(travel, lines), sign * 0.07 * lines)
    torch.testing.assert_close(line_at(travel, travel_at(travel, lines)), lines)


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_travel_by_log(transport: str) -> None:
    travel, sign = Travel(0.1, LOG, transport), -1.0 if transport == "reverse" else 1.0
    lines = f64([0.0, 0.5, 1.0, 1.25, 3.0, 5.0, -2.0])
    expected = f64([1.0, 1.25, 1.5, 1.75, 2.75, 2.95, 0.8])  # beyond the ends 0.1 mm a line
    torch.testing.assert_close(travel_at(travel, lines), sign * expected)
    torch.testing.assert_close(line_at(travel, sign * expected), lines)


def test_travel_by_log_batch_equals_loop() -> None:
    travel = Travel(0.1, torch.rand(50, dtype=torch.float64).cumsum(0))
    lines = torch.rand(3, 4, dtype=torch.float64) * 60 - 5
    batched = travel_at(travel, lines)
    back = line_at(travel, batched)
    for i in range(3):
        for j in range(4):
            assert torch.equal(batched[i, j], travel_at(travel, lines[i, j]))
            assert torch.equal(back[i, j], line_at(travel, batched[i, j]))


@given(
    st.lists(st.floats(0.01, 1.0), min_size=1, max_size=20),
    st.lists(st.floats(-10, 40), min_size=1, max_size=10),
    st.sampled_from(["forward", "reverse"]),
)
def test_line_at_inverts_travel_at(steps: list[float], lines: list[float], transport: str) -> None:
    travel = Travel(0.07, f64(steps).cumsum(0), transport)
    at = f64(lines)
    torch.testing.assert_close(line_at(travel, travel_at(travel, at)), at, rtol=0, atol=1e-9)


def test_even_log_is_the_pitch() -> None:
    log = torch.arange(100).double() * 0.07
    lines = torch.rand(50, dtype=torch.float64) * 120 - 10
    torch.testing.assert_close(travel_at(Travel(0.07, log), lines), travel_at(Travel(0.07), lines))
    travelled = torch.rand(50, dtype=torch.float64) * 9 - 1
    torch.testing.assert_close(line_at(Travel(0.07, log), travelled), line_at(Travel(0.07), travelled))


@pytest.mark.parametrize("log", [None, LOG, LOG[:1]])
def test_missing_lines_stay_missing(log: torch.Tensor | None) -> None:
    travel = Travel(0.1, log)
    at = f64([torch.nan, 1.0])
    assert travel_at(travel, at).isnan().tolist() == [True, False]
    assert line_at(travel, at).isnan().tolist() == [True, False]


def test_derivative_of_travel_is_the_local_pitch() -> None:
    lines = f64([-1.0, 0.25, 1.5, 2.5, 9.0]).requires_grad_()
    travel_at(Travel(0.1, LOG), lines).sum().backward()
    assert lines.grad.tolist() == pytest.approx([0.1, 0.5, 1.0, 0.25, 0.1])


@pytest.mark.parametrize("log", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.0, torch.nan, 2.0]])
def test_log_must_increase(log: list[float]) -> None:
    travel = Travel(0.1, f64(log))
    for function in (travel_at, line_at):
        with pytest.raises(ValueError, match="must increase"):
            function(travel, torch.zeros(1).double())
