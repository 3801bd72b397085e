"""Raw pairs and their ideal ones: the oracle is where the raw cameras see points of a moving object."""

import dataclasses

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
from tests.raw_cameras import RAW, TILT

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


def test_disparities_of_matched_columns_mean_where_the_raw_rays_meet():
    rectification = Rectification.of(RAW, N)
    assert rectification is not None
    columns, disparity = rectification.matched_columns, torch.linspace(-180, 180, 9, dtype=torch.float64)[:, None]
    disparity = disparity.expand(-1, rectification.rig.width_px).contiguous()
    partner = rectification.ideal_column(columns.places - disparity)  # where the matched right image looks
    right = rectification.raw_column(partner, "right")
    seen = (right >= 0) & (right <= 7141)
    met = rectification.raw.meet(columns.places, right, N)
    exact, single = columns.depth(disparity), columns.part(slice(None), torch.empty(0)).depth(disparity.float())
    assert (exact - met.z)[seen].abs().max() < 3e-4
    assert (single - met.z)[seen].abs().max() < 6e-4
    matched = rectification.matched_right_columns
    whole = torch.arange(7142, dtype=torch.float64)
    torch.testing.assert_close(matched, rectification.raw_column(rectification.ideal_column(whole), "right"))
    step = (columns.depth(disparity + 1e-3) - exact)[4:5] / 1e-3
    sigma = columns.depth_sigma(exact[4:5], torch.ones_like(exact[4:5]))
    assert ((sigma + step) / sigma).abs().max() < 0.02
    assert columns.depth(torch.full_like(disparity, -9000.0)).isnan().all()


def test_heights_have_no_larger_disparities_than_the_matched_pair_says():
    rectification = Rectification.of(RAW)
    assert rectification is not None
    rig, whole = rectification.rig, torch.arange(7142, dtype=torch.float64)
    assert zero_disparity_mm(rectification.matched_rig) == pytest.approx(zero_disparity_mm(rig), rel=1e-12)
    for height in DEPTHS_MM:
        ideal = rectification.ideal_column(whole)
        partner = ideal - disparity_at_height(rig, height)
        raw = whole - rectification.raw_column(partner)
        largest = disparity_at_height(rectification.matched_rig, height)
        assert (raw / largest <= 1.001).all()
        assert (raw / largest).max() > 0.98


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (0, 1), (1, 0)])
def test_sheared_rows_show_a_point_on_one_row_at_every_depth(signs):
    raw = dataclasses.replace(RAW, view_plane=ViewPlane(0.25, signs[0] * TILT, signs[1] * TILT))
    rectification = Rectification.of(raw, N)
    assert rectification is not None
    points = field(rectification.rig)
    lowest, highest = (disparity_at_height(rectification.matched_rig, height) for height in DEPTHS_MM)
    shear = rectification.row_shear((lowest, highest))
    assert shear is not None
    left, right = rectification.raw.seen_left(points, N), rectification.raw.seen_right(points, N)
    # The columns that the raw right image is read in are those of the left one.
    partner = rectification.raw_column(rectification.ideal_column(right.column, "right"))
    late = [
        seen.travel - at(shift, column)
        for seen, shift, column in ((left, shear.left_mm, left.column), (right, shear.right_mm, partner))
    ]
    seen = (partner >= 0) & (partner <= 7141)
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
