"""Raw cameras: the oracle is a ray traced by hand, the shared data hold a renderer of somebody else."""

import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lsvision.geometry import LineCamera, RawPair, quantities_of, slope_at, triangulate, with_quantities
from lsvision.types import Board, RawCamera, RawRig, Rig, ViewPlane

PITCH_UM = 80.0
RIG = RawRig(
    893, PITCH_UM, 354.0,
    RawCamera(114.1, 446.4, 0.2212, (0.012, -0.01)),
    RawCamera(113.6, 445.7, -0.2203, (-0.009, 0.006)),
    ViewPlane(0.25, 0.0026, 0.0017),
)  # fmt: skip


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def points(count: int) -> torch.Tensor:
    """Points of an object all over the field and its depth, on line 0."""
    low, high = numbers(-60, 0, 765), numbers(410, 300, 830)
    return low + (high - low) * torch.rand(count, 3, dtype=torch.float64)


N = numbers(0.03, 1.02, -0.016)


@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.3, 0.3))
def test_a_column_looks_along_its_slope(k1, k2, turn):
    camera = LineCamera(numbers(1425.0), numbers(440.0), numbers(turn), numbers(k1), numbers(k2))
    columns = torch.linspace(0, 892, 50, dtype=torch.float64)
    assert torch.allclose(camera.column(camera.slope(columns)), columns, rtol=0, atol=1e-9)


def test_the_ray_leaves_at_the_stated_angle():
    camera = RawPair.of(RIG).left
    t = (700.0 - 446.4) / (114.1 / 0.08)
    angle = math.atan(t * (1 + 0.012 * t**2 - 0.01 * t**4)) + 0.2212
    assert float(camera.slope(numbers(700.0))[0]) == pytest.approx(math.tan(angle), rel=1e-12)


def test_a_camera_sees_a_point_when_it_crosses_its_plane():
    pair, body = RawPair.of(RIG), points(200)
    left, right = pair.seen_left(body, N), pair.seen_right(body, N)
    at_left, at_right = (body - seen.travel[:, None] * N for seen in (left, right))
    assert torch.allclose(at_left[:, 1], torch.zeros_like(at_left[:, 1]), atol=1e-10)
    plane = 0.25 + 0.0026 * (at_right[:, 0] - 177.0) + 0.0017 * (at_right[:, 2] - pair.z0_mm)
    assert torch.allclose(at_right[:, 1], plane, rtol=0, atol=1e-10)
    slope = pair.right.slope(right.column)
    assert torch.allclose(slope * at_right[:, 2] + 354.0, at_right[:, 0], rtol=0, atol=1e-9)


def test_rays_meet_at_the_point_that_was_seen():
    pair, body = RawPair.of(RIG), points(200)
    left, right = pair.seen_left(body, N), pair.seen_right(body, N)
    met, there = pair.meet(left.column, right.column, N), body - left.travel[:, None] * N
    assert torch.allclose(met.x, there[:, 0], rtol=0, atol=1e-9)
    assert torch.allclose(met.z, there[:, 2], rtol=0, atol=1e-9)
    assert torch.allclose(met.later_mm, right.travel - left.travel, rtol=0, atol=1e-10)


def test_cameras_without_turn_distortion_and_offset_are_a_rectified_pair():
    rectified = Rig(893, PITCH_UM, 113.84, 354.0, 130.0, 762.0)
    raw = RawRig(893, PITCH_UM, 354.0, RawCamera(113.84, 130.0), RawCamera(113.84, 762.0))
    pair, columns = RawPair.of(raw), torch.linspace(0, 892, 30, dtype=torch.float64)
    assert torch.allclose(pair.left.slope(columns), slope_at(rectified, columns), rtol=0, atol=1e-14)
    met = pair.meet(columns, columns - 7.5, N)
    x, z = triangulate(rectified, columns, torch.full_like(columns, 7.5))
    assert torch.allclose(met.x, x, rtol=0, atol=1e-10)
    assert torch.allclose(met.z, z, rtol=0, atol=1e-10)
    assert not bool(met.later_mm.any())


def test_other_quantities_make_another_rig():
    values = quantities_of(RIG) + 1e-3 * torch.rand(14, dtype=torch.float64)
    again = quantities_of(with_quantities(RIG, values))
    moved = float(RawPair.of(with_quantities(RIG, values)).z0_mm - RawPair.of(RIG).z0_mm)
    offset = torch.zeros(14, dtype=torch.float64).index_fill(0, torch.tensor(11), moved * float(values[13]))
    assert torch.allclose(again, values + offset, rtol=0, atol=1e-12)
    body = points(20)
    one, other = (
        pair.seen_right(body, N) for pair in (RawPair.of(RIG, values), RawPair.of(with_quantities(RIG, values)))
    )
    assert torch.allclose(one.column, other.column, rtol=0, atol=1e-9)
    assert torch.allclose(one.travel, other.travel, rtol=0, atol=1e-11)


def test_derivatives_pass_through():
    pair, body = RawPair.of(RIG), points(3)

    def seen(body, turn):
        left = LineCamera(pair.left.focal_px, pair.left.principal_px, turn, pair.left.k1, pair.left.k2)
        moved = RawPair(left, pair.right, pair.baseline_mm, pair.plane, pair.z0_mm)
        return moved.seen_left(body, N).column, moved.seen_right(body, N).travel

    inputs = (body.requires_grad_(), pair.left.turn.clone().requires_grad_())
    assert torch.autograd.gradcheck(seen, inputs)


@pytest.mark.parametrize("name", ["raw_a", "raw_f"])
def test_another_renderers_corners_are_where_its_truth_says(shared_data, name):
    from lsvision.image.board.detect import detect_board
    from lsvision.io.images.line_image import open_line_image

    folder = shared_data / "scans_shaken_and_raw" / name
    truth = json.loads((folder / "truth.json").read_text())
    body = Board(12, 9, 30.0).corner_points() @ numbers(*truth["R"]).mT + numbers(*truth["T"])
    left, right = ((LineCamera(*numbers(*(truth[side][key] for key in ("f_px", "c", "turn", "k1", "k2")))))
                   for side in ("left", "right"))  # fmt: skip
    plane = numbers(*(truth["right"][key] for key in ("s0", "s1", "s2")))
    pair = RawPair(left, right, numbers(354.0)[0], plane, numbers(796.9)[0])
    for side, see in (("left", pair.seen_left), ("right", pair.seen_right)):
        found = detect_board(open_line_image(folder / f"{side}.tif"), Board(12, 9, 30.0))
        assert found is not None
        seen = see(body, numbers(*truth["n"]))
        off = found.position - torch.stack([seen.column, seen.travel / 0.56], dim=-1)
        assert float(off[found.valid].abs().max()) < 0.06
