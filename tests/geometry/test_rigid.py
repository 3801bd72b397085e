import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.func import jacrev, vmap

from lsvision.geometry import (
    euler_angles,
    fit_rigid,
    left_jacobian,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)

EYE = torch.eye(3, dtype=torch.float64)
ANGLES = [0.0, 1e-12, 1e-6, 0.999e-3, 1.001e-3, 0.1, 1.0, 3.0, math.pi - 1e-6, math.pi - 1e-12]


def unit(*batch: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(*batch, 3, dtype=torch.float64), dim=-1)


def cross(vector: torch.Tensor) -> torch.Tensor:
    x, y, z = vector.tolist()
    return torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)


def test_batch_equals_loop() -> None:
    vectors = unit(2, 3) * torch.rand(2, 3, 1, dtype=torch.float64) * 3
    rotations = rotation_from_vector(vectors)
    points = torch.randn(2, 3, 5, 3, dtype=torch.float64)
    moved = transform(rotations, vectors, points)
    pose = fit_rigid(points, moved)
    fitted_rotation, fitted_translation = pose.rotation, pose.translation
    for i in range(2):
        for j in range(3):
            for function, argument in (
                (rotation_from_vector, vectors),
                (left_jacobian, vectors),
                (vector_from_rotation, rotations),
                (euler_angles, rotations),
            ):
                torch.testing.assert_close(function(argument)[i, j], function(argument[i, j]), rtol=1e-14, atol=1e-15)
            single = transform(rotations[i, j], vectors[i, j], points[i, j])
            torch.testing.assert_close(moved[i, j], single, rtol=1e-14, atol=1e-14)
            pose = fit_rigid(points[i, j], single)
            rotation, translation = pose.rotation, pose.translation
            torch.testing.assert_close(fitted_rotation[i, j], rotation, rtol=0, atol=1e-13)
            torch.testing.assert_close(fitted_translation[i, j], translation, rtol=0, atol=1e-13)


def test_quarter_turns() -> None:
    about_z = rotation_from_vector(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    expected = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(about_z, expected, rtol=0, atol=1e-15)
    shift, point = torch.tensor([[10.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype=torch.float64)
    moved = transform(about_z, shift, point[None])
    torch.testing.assert_close(moved, torch.tensor([[8.0, 1.0, 3.0]], dtype=torch.float64))


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_is_the_matrix_exponential(angle: float) -> None:
    for vector in unit(5) * angle:
        rotation = rotation_from_vector(vector)
        torch.testing.assert_close(rotation, torch.linalg.matrix_exp(cross(vector)), rtol=0, atol=1e-14)
        torch.testing.assert_close(rotation @ rotation.mT, EYE, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_vector_round_trip(angle: float) -> None:
    vectors = unit(50) * angle
    torch.testing.assert_close(vector_from_rotation(rotation_from_vector(vectors)), vectors, rtol=1e-13, atol=1e-15)


@given(st.tuples(*[st.floats(-1.8, 1.8)] * 3))
def test_any_vector_round_trips(components: tuple[float, float, float]) -> None:
    vector = torch.tensor(components, dtype=torch.float64)
    torch.testing.assert_close(vector_from_rotation(rotation_from_vector(vector)), vector, rtol=1e-11, atol=1e-14)


def test_half_turns_have_length_pi() -> None:
    axes = torch.cat([EYE, unit(20)])
    rotations = 2 * axes[:, :, None] * axes[:, None, :] - EYE
    vectors = vector_from_rotation(rotations)
    torch.testing.assert_close(
        vectors.norm(dim=-1), torch.full((23,), math.pi, dtype=torch.float64), rtol=1e-14, atol=0
    )
    torch.testing.assert_close(rotation_from_vector(vectors), rotations, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.9e-3, 1.1e-3, 0.5, 3.0])
def test_rotation_is_differentiable(angle: float) -> None:
    vector = (unit() * angle).requires_grad_()
    assert torch.autograd.gradcheck(rotation_from_vector, vector)
    assert torch.autograd.gradcheck(left_jacobian, vector)
    assert torch.autograd.gradcheck(lambda v: vector_from_rotation(rotation_from_vector(v)), vector)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.999e-3, 1.001e-3, 0.5, 3.0])
def test_left_jacobian_is_the_derivative(angle: float) -> None:
    vector = unit() * angle
    rotation = rotation_from_vector(vector)

    def turn(change: torch.Tensor) -> torch.Tensor:
        return vector_from_rotation(rotation_from_vector(vector + change) @ rotation.mT)

    derivative = jacrev(turn)(torch.zeros_like(vector))
    torch.testing.assert_close(left_jacobian(vector), derivative, rtol=0, atol=1e-12)


def test_left_jacobian_at_a_known_place() -> None:
    turn = math.pi / 2
    jacobian = left_jacobian(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
    inverse = 1 / turn
    rows = [[inverse, -inverse, 0.0], [inverse, inverse, 0.0], [0.0, 0.0, 1.0]]
    expected = torch.tensor(rows, dtype=torch.float64)
    torch.testing.assert_close(jacobian, expected)


def test_euler_angles_undo_turns_about_x_then_y_then_z() -> None:
    angles = torch.tensor([0.3, -0.7, 2.5], dtype=torch.float64)
    x, y, z = (rotation_from_vector(axis * angle) for axis, angle in zip(EYE, angles, strict=True))
    torch.testing.assert_close(euler_angles(z @ y @ x), angles)


def test_fit_recovers_the_motion() -> None:
    rotation, translation = rotation_from_vector(unit(4) * 2), torch.randn(4, 3, dtype=torch.float64) * 500
    source = torch.randn(20, 3, dtype=torch.float64) * 100
    fitted = fit_rigid(source, transform(rotation, translation, source.expand(4, 20, 3)))
    torch.testing.assert_close(fitted.rotation, rotation, rtol=0, atol=1e-13)
    torch.testing.assert_close(fitted.translation, translation, rtol=0, atol=1e-11)


def test_fit_of_a_plane_is_a_proper_rotation() -> None:
    board = torch.cat([torch.randn(30, 2, dtype=torch.float64) * 100, torch.zeros(30, 1).double()], -1)
    rotation = rotation_from_vector(unit() * 0.2)
    noisy = transform(rotation, torch.zeros(3).double(), board) + 1e-3 * torch.randn(30, 3, dtype=torch.float64)
    fitted = fit_rigid(board, noisy).rotation
    assert float(torch.linalg.det(fitted)) == pytest.approx(1.0)
    torch.testing.assert_close(fitted, rotation, rtol=0, atol=1e-4)


def test_fit_of_a_mirrored_cloud_is_a_proper_rotation() -> None:
    source = torch.randn(30, 3, dtype=torch.float64)
    fitted = fit_rigid(source, source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)).rotation
    assert float(torch.linalg.det(fitted)) == pytest.approx(1.0)


def test_no_small_change_fits_better() -> None:
    source, target = torch.randn(2, 15, 3, dtype=torch.float64)
    pose = fit_rigid(source, target)
    rotation, translation = pose.rotation, pose.translation

    def cost(turn: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        turned = rotation_from_vector(turn) @ rotation
        return (transform(turned, translation + shift, source) - target).square().sum((-2, -1))

    best = cost(torch.zeros(3).double(), torch.zeros(3).double())
    changes = vmap(cost)(*(1e-3 * torch.randn(2, 200, 3, dtype=torch.float64)))
    assert (changes > best).all()


def test_fit_ignores_masked_points() -> None:
    source, target = torch.randn(2, 3, 12, 3, dtype=torch.float64)
    valid = torch.rand(3, 12) < 0.6
    source[~valid], target[~valid] = torch.nan, 1e9
    pose = fit_rigid(source, target, valid)
    rotation, translation = pose.rotation, pose.translation
    for i in range(3):
        alone = fit_rigid(source[i, valid[i]], target[i, valid[i]])
        torch.testing.assert_close(rotation[i], alone.rotation, rtol=0, atol=1e-12)
        torch.testing.assert_close(translation[i], alone.translation, rtol=0, atol=1e-12)


def test_one_mask_serves_many_point_sets() -> None:
    source, target = torch.randn(2, 4, 10, 3, dtype=torch.float64)
    valid = torch.arange(10) > 3
    torch.testing.assert_close(
        fit_rigid(source, target, valid).rotation, fit_rigid(source[:, 4:], target[:, 4:]).rotation
    )


def test_many_masks_serve_one_point_set() -> None:
    source, target = torch.randn(2, 10, 3, dtype=torch.float64)
    valid = torch.rand(4, 10) < 0.7
    pose = fit_rigid(source, target, valid)
    rotation, translation = pose.rotation, pose.translation
    for i in range(4):
        alone = fit_rigid(source[valid[i]], target[valid[i]])
        torch.testing.assert_close(rotation[i], alone.rotation, rtol=0, atol=1e-12)
        torch.testing.assert_close(translation[i], alone.translation, rtol=0, atol=1e-12)


def test_problem_without_points_does_not_end_the_batch() -> None:
    source, target = torch.randn(2, 2, 10, 3, dtype=torch.float64)
    valid = torch.stack([torch.ones(10), torch.zeros(10)]).bool()
    pose = fit_rigid(source, target, valid)
    rotation, translation = pose.rotation, pose.translation
    torch.testing.assert_close(rotation[0], fit_rigid(source[0], target[0]).rotation)
    assert rotation[1].isnan().all()
    assert translation[1].isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(dtype: torch.dtype) -> None:
    vectors = unit(3).to(dtype)
    rotations = rotation_from_vector(vectors)
    results = (
        rotations,
        left_jacobian(vectors),
        vector_from_rotation(rotations),
        *vars(fit_rigid(rotations, rotations)).values(),
    )
    assert {result.dtype for result in results} == {dtype}
