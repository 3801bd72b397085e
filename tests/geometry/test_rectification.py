"""Raw pairs and their ideal ones: the oracle is where the raw cameras see points of a moving object."""

import dataclasses
import math

import pytest
import torch

from lsvision.geometry import (
    Rectification,
    disparity_at_height,
    ideal_rig,
    is_rectified,
    scaled_rig,
    slope_at,
    zero_disparity_mm,
)
from lsvision.types import RawCamera, RawRig, Rig, ViewPlane

TILT = math.radians(0.2)
RAW = RawRig(
    7142, 10.0, 354.0,
    RawCamera(114.1, 3571.0, 0.2212, (0.012, -0.01)),
    RawCamera(113.6, 3569.6, -0.2203, (-0.009, 0.006)),
    ViewPlane(0.25, TILT, -TILT),
)  # fmt: skip
PITCH_MM = 0.07
DEPTHS_MM = (-26.9, 25.2)  # of the camera, about the plane of zero disparity
N = torch.tensor([0.03, 1.02, -0.016], dtype=torch.float64)


def field(rig: Rig, count: int = 4000) -> torch.Tensor:
    """Points all over the field and depth of a pair, on lines 0 to 300 mm of travel."""
    share = torch.rand(count, 3, dtype=torch.float64)
    z = zero_disparity_mm(rig) - DEPTHS_MM[0] - (DEPTHS_MM[1] - DEPTHS_MM[0]) * share[:, 2]
    slope = slope_at(rig, share[:, 0] * (rig.width_px - 1))
    travel = 300 * share[:, 1]
    return torch.stack([slope * z, torch.zeros_like(z), z], dim=-1) + travel[:, None] * N


def test_a_pair_that_is_rectified_already_stays_as_it_is():
    rig = scaled_rig(Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0, (-4.0, 0.0, 4.0)), 7)
    left, right = RawCamera(rig.focal_length_mm, rig.principal_left_px), RawCamera(113.84, rig.principal_right_px)
    raw = RawRig(rig.width_px, rig.pixel_pitch_um, 354.0, left, right, color_spacing_lines=rig.color_spacing_lines)
    assert ideal_rig(raw) == rig
    assert Rectification.of(raw) is None
    assert Rectification.of(None) is None
    for change in (
        {"left": dataclasses.replace(left, turn_rad=1e-3)},
        {"right": dataclasses.replace(right, distortion=(0.0, 1e-4))},
        {"right": dataclasses.replace(right, focal_length_mm=113.9)},
        {"view_plane": ViewPlane(0.01)},
    ):
        assert not is_rectified(dataclasses.replace(raw, **change))


def test_the_ideal_pair_holds_the_left_field_and_meets_in_the_middle():
    rig = ideal_rig(RAW)
    rectification = Rectification.of(RAW)
    assert rectification is not None
    assert rig.focal_length_mm == pytest.approx((114.1 + 113.6) / 2)
    assert zero_disparity_mm(rig) == pytest.approx(float(rectification.raw.z0_mm), abs=1e-6)
    ends = rectification.ideal_column(torch.tensor([0.0, 7141.0], dtype=torch.float64))
    assert abs(float(ends[0])) < 1e-6
    assert rig.width_px - 2 < float(ends[1]) < rig.width_px - 1 + 1e-6


@pytest.mark.parametrize("camera", ["left", "right"])
def test_columns_there_and_back(camera):
    rectification = Rectification.of(RAW)
    assert rectification is not None
    columns = torch.linspace(0, 7141, 77, dtype=torch.float64)
    there = rectification.ideal_column(columns, camera)
    torch.testing.assert_close(rectification.raw_column(there, camera), columns, rtol=0, atol=1e-8)
    growth = (rectification.ideal_column(columns + 1e-3, camera) - there) / 1e-3
    torch.testing.assert_close(rectification.growth(columns, camera), growth, rtol=0, atol=1e-4)
    if camera == "left":
        whole = torch.arange(rectification.rig.width_px, dtype=torch.float64)
        torch.testing.assert_close(rectification.raw_left_columns, rectification.raw_column(whole))


def test_depth_of_disparities_is_where_the_raw_rays_meet():
    rectification = Rectification.of(RAW, N)
    assert rectification is not None
    points = field(rectification.rig)
    left, right = rectification.raw.seen_left(points, N), rectification.raw.seen_right(points, N)
    u = rectification.ideal_column(left.column)
    disparity = u - rectification.ideal_column(right.column, "right")
    met = rectification.meet(u, disparity)
    expected = (points - left.travel[:, None] * N)[:, 2]
    torch.testing.assert_close(met.z, expected, rtol=0, atol=1e-8)
    rows = torch.linspace(-165, 165, 9)[:, None].expand(-1, rectification.rig.width_px)
    columns = torch.arange(rectification.rig.width_px, dtype=torch.float64)
    exact = rectification.meet(columns, rows.double()).z
    assert (rectification.depth(rows) - exact).abs().max() < 4e-4  # single precision
    assert rectification.depth(torch.full_like(rows, -8000.0)).isnan().all()


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (0, 1), (1, 0)])
def test_sheared_rows_show_a_point_on_one_row_at_every_depth(signs):
    raw = dataclasses.replace(RAW, view_plane=ViewPlane(0.25, signs[0] * TILT, signs[1] * TILT))
    rectification = Rectification.of(raw, N)
    assert rectification is not None
    rig, points = rectification.rig, field(rectification.rig)
    lowest, highest = (disparity_at_height(rig, height) for height in DEPTHS_MM)
    shear = rectification.row_shear((lowest, highest))
    assert shear is not None
    left, right = rectification.raw.seen_left(points, N), rectification.raw.seen_right(points, N)
    columns = rectification.ideal_column(left.column), rectification.ideal_column(right.column, "right")
    seen = (columns[1] >= 0) & (columns[1] <= rig.width_px - 1)
    late = [
        seen_on.travel - at(shift, column)
        for seen_on, shift, column in zip((left, right), (shear.left_mm, shear.right_mm), columns, strict=True)
    ]
    error = (late[1] - late[0])[seen].abs().max() / PITCH_MM
    assert error < 0.05
    assert error <= 1.2 * shear.error_mm / PITCH_MM + 1e-3
    # A shift by column alone leaves more than a line.
    plain = (right.travel - left.travel)[seen]
    assert (plain.max() - plain.min()) / PITCH_MM > 2


def at(values: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Values by column, between whole ones."""
    base = column.floor().clamp(0, len(values) - 2).long()
    return torch.lerp(values[base], values[base + 1], column - base)


def test_planes_that_are_one_need_no_shear_and_an_offset_alone_moves_the_right_image():
    one = Rectification.of(dataclasses.replace(RAW, view_plane=ViewPlane()))
    assert one is not None
    assert one.row_shear((-165.0, 165.0)) is None
    beside = Rectification.of(dataclasses.replace(RAW, view_plane=ViewPlane(0.25)))
    assert beside is not None
    shear = beside.row_shear((-165.0, 165.0))
    assert shear is not None
    assert shear.left_mm.abs().max() < 1e-9
    assert (shear.right_mm + 0.25).abs().max() < 1e-9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"left": RawCamera(114.0, 3570.0, -0.3)}, "no common point in front"),
        ({"left": RawCamera(114.0, 3570.0, 1.5)}, "left: expected columns that look along growing slopes"),
        ({"right": RawCamera(114.0, 3570.0, 0.0, (-20.0, 0.0))}, "right: expected columns that look along growing"),
    ],
)
def test_cameras_that_see_no_common_field(change, message):
    with pytest.raises(ValueError, match=message):
        ideal_rig(dataclasses.replace(RAW, **change))
