import math

import pytest
import torch
from torch.func import jacrev, vmap

from lsvision.geometry import (
    CoplanarRig,
    Intersection,
    focal_length_px,
    object_pitch_mm,
    project,
    scaled_rig,
    triangulate,
    triangulate_general,
    triangulation_jacobian,
    zero_disparity_mm,
)
from lsvision.types import Rig

FULL = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)


def pixels(*shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Columns over the sensor and disparities over the rig's range, full size."""
    return torch.rand(*shape, dtype=torch.float64) * 7141, torch.rand(*shape, dtype=torch.float64) * 330 - 165


def intersect(origin: torch.Tensor, first: torch.Tensor, second: torch.Tensor, baseline: float) -> torch.Tensor:
    """Where the ray ``origin + s first`` meets ``(baseline, 0) + t second``, by solving for s and t."""
    system = torch.stack([first, -second], dim=-1)
    offset = torch.tensor([baseline, 0.0], dtype=first.dtype) - origin
    s, _ = torch.linalg.solve(system, offset)
    return origin + s * first


def general(left_px: torch.Tensor, disparity_px: torch.Tensor) -> Intersection:
    """The rectified rig seen as a general one: columns count towards larger X, image coordinates the other way."""
    left_mm = -(left_px - FULL.principal_left_px) * FULL.pixel_pitch_um * 1e-3
    right_mm = -(left_px - disparity_px - FULL.principal_right_px) * FULL.pixel_pitch_um * 1e-3
    rig = CoplanarRig(FULL.focal_length_mm, FULL.focal_length_mm, FULL.baseline_mm, alpha=0.0, beta=math.pi / 2)
    return triangulate_general(left_mm, right_mm, rig)


def test_batch_equals_loop() -> None:
    left, disparity = pixels(2, 3)
    batched = torch.stack(triangulate(FULL, left, disparity))
    jacobian = triangulation_jacobian(FULL, left, disparity)
    whole = general(left, disparity)
    points, depth = whole.points, whole.depth_mm
    seen = torch.stack(project(FULL, *batched))
    for i in range(2):
        for j in range(3):
            one = left[i, j], disparity[i, j]
            assert torch.equal(batched[:, i, j], torch.stack(triangulate(FULL, *one)))
            assert torch.equal(jacobian[i, j], triangulation_jacobian(FULL, *one))
            assert torch.equal(seen[:, i, j], torch.stack(project(FULL, *batched[:, i, j])))
            torch.testing.assert_close(points[i, j], general(*one).points, rtol=1e-14, atol=0)
            torch.testing.assert_close(depth[i, j], general(*one).depth_mm, rtol=1e-14, atol=0)


def test_default_rig_of_table_1() -> None:
    assert pytest.approx(796.9, abs=0.05) == zero_disparity_mm(FULL)
    assert pytest.approx(0.070, abs=1e-5) == object_pitch_mm(FULL)
    centre = torch.tensor(1042.0, dtype=torch.float64)
    jacobian = triangulation_jacobian(FULL, centre, torch.zeros_like(centre))
    assert float(-jacobian[1, 1]) == pytest.approx(0.1576, abs=5e-5)
    assert pytest.approx(0.089, abs=5e-4) == 0.014 / 0.1576
    _, z = triangulate(FULL, centre.expand(2), centre.new_tensor([-165.0, 165.0]))
    assert float(z[0] - z[1]) == pytest.approx(52.0, abs=0.2)


def test_worked_example() -> None:
    rig = Rig(100, 10.0, 10.0, 100.0, 20.0, 70.0)  # f = 1000 px
    left, disparity = torch.tensor(70.0, dtype=torch.float64), torch.tensor(50.0, dtype=torch.float64)
    x, z = triangulate(rig, left, disparity)
    assert (float(x), float(z)) == (50.0, 1000.0)  # 1000 * 100 / (50 + 50); 50 px of 1000 at 1000 mm
    left_px, right_px = project(rig, x, z)
    assert (float(left_px), float(right_px)) == (70.0, 20.0)


def test_columns_grow_with_x_and_disparity_towards_the_cameras() -> None:
    u, d = torch.tensor([100.0, 200.0], dtype=torch.float64), torch.tensor([10.0, 10.0], dtype=torch.float64)
    x, _ = triangulate(FULL, u, d)
    assert x[1] > x[0]
    _, z = triangulate(FULL, u, d + torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert z[1] < z[0]


def test_projection_inverts_triangulation() -> None:
    left, disparity = pixels(500)
    left_px, right_px = project(FULL, *triangulate(FULL, left, disparity))
    torch.testing.assert_close(left_px, left, rtol=0, atol=1e-9)
    torch.testing.assert_close(left_px - right_px, disparity, rtol=0, atol=1e-9)


def test_both_forms_agree_with_intersected_rays_on_a_rectified_rig() -> None:
    left, disparity = pixels(200)
    x, z = triangulate(FULL, left, disparity)
    met = general(left, disparity)
    points, depth, valid = met.points, met.depth_mm, met.valid
    assert valid.all()
    torch.testing.assert_close(points, torch.stack([x, z], -1), rtol=0, atol=1e-9)
    torch.testing.assert_close(depth + FULL.focal_length_mm, z, rtol=0, atol=1e-9)
    slopes = torch.stack([left - FULL.principal_left_px, left - disparity - FULL.principal_right_px])
    first, second = torch.stack([slopes / focal_length_px(FULL), torch.ones_like(slopes)], -1)
    for i in range(200):
        brute = intersect(torch.zeros(2).double(), first[i], second[i], FULL.baseline_mm)
        torch.testing.assert_close(points[i], brute, rtol=0, atol=1e-9)


def test_general_form_meets_intersected_rays_at_any_angle() -> None:
    count = 200
    left_mm, right_mm = (torch.rand(2, count, dtype=torch.float64) - 0.5) * 40
    alphas, betas = torch.rand(2, count, dtype=torch.float64)
    for i in range(count):
        alpha, beta = 0.3 + 0.5 * float(alphas[i]), 1.0 + 0.6 * float(betas[i])
        focal_left, focal_right = 90.0, 110.0
        rig = CoplanarRig(focal_left, focal_right, 354.0, alpha, beta)
        met = triangulate_general(left_mm[i], right_mm[i], rig)
        points, depth, valid = met.points, met.depth_mm, met.valid
        # A sensor behind the lens, turned with its axis: the ray leaves through the lens, opposite to the pixel.
        left_axis = torch.tensor([math.cos(beta), math.sin(beta)], dtype=torch.float64)
        right_axis = torch.tensor([math.cos(beta + alpha), math.sin(beta + alpha)], dtype=torch.float64)
        turned = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
        first = focal_left * left_axis + left_mm[i] * (turned @ left_axis)
        second = focal_right * right_axis + right_mm[i] * (turned @ right_axis)
        brute = intersect(torch.zeros(2).double(), first, second, 354.0)
        assert valid
        torch.testing.assert_close(points, brute, rtol=0, atol=1e-9)
        along = (brute - torch.tensor([354.0, 0.0], dtype=torch.float64)) @ right_axis
        torch.testing.assert_close(depth, along - focal_right, rtol=0, atol=1e-9)


def test_parallel_rays_and_points_behind_are_nan_beside_good_ones() -> None:
    parallel = -(FULL.principal_right_px - FULL.principal_left_px)
    left = torch.full((4,), 1042.0, dtype=torch.float64)
    disparity = torch.tensor([0.0, parallel, parallel - 100.0, torch.nan], dtype=torch.float64)
    x, z = triangulate(FULL, left, disparity)
    met = general(left, disparity)
    points, depth, valid = met.points, met.depth_mm, met.valid
    assert valid.tolist() == [True, False, False, False]
    for result in (x, z, depth, points[:, 0], points[:, 1]):
        assert result.isfinite().tolist() == [True, False, False, False]
    left_px, right_px = project(FULL, x.new_zeros(3), x.new_tensor([1.0, 0.0, -1.0]))
    assert left_px.isfinite().tolist() == right_px.isfinite().tolist() == [True, False, False]


def test_derivative_of_triangulation() -> None:
    left, disparity = pixels(20)

    def position(at: torch.Tensor) -> torch.Tensor:
        return torch.stack(triangulate(FULL, at[0], at[1]))

    exact = vmap(jacrev(position))(torch.stack([left, disparity], -1))
    torch.testing.assert_close(triangulation_jacobian(FULL, left, disparity), exact, rtol=1e-12, atol=1e-15)


def test_gradient_of_good_points_survives_bad_ones() -> None:
    disparity = torch.tensor([3.0, -9000.0], dtype=torch.float64, requires_grad=True)
    _, z = triangulate(FULL, torch.full_like(disparity, 50.0), disparity)
    z[0].backward()
    assert disparity.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(dtype: torch.dtype) -> None:
    x, z = triangulate(FULL, torch.zeros(3, dtype=dtype), torch.zeros(3, dtype=dtype))
    assert x.dtype == z.dtype == dtype


def test_scaled_rig_keeps_the_field_and_its_edge() -> None:
    rig = scaled_rig(FULL, 4)
    assert rig.width_px == 1786
    torch.testing.assert_close(
        [rig.pixel_pitch_um, rig.principal_left_px, rig.principal_right_px, zero_disparity_mm(rig)],
        [40.0, 260.125, 1524.375, zero_disparity_mm(FULL)],
    )
    assert scaled_rig(FULL, 1) == FULL
    with pytest.raises(ValueError, match="scale"):
        scaled_rig(FULL, 0.5)
