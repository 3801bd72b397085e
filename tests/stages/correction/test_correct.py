"""Products of planes and steps whose depth is known: where every cell came from, and what it may not invent."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.geometry import (
    focal_length_px,
    line_at,
    object_pitch_mm,
    product_axes,
    to_product,
    travel_at,
    zero_disparity_mm,
)
from lsvision.image.tiling import PIXEL_PARTS
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import Correction, correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, Motion, Rig, Scan, TensorImage, Travel
from tests.stages.rendered import BOARD, PITCH, SMALL_RIG, depth_scan, motion_of

LINES = 150
DEPTH = 790.0
RIG = dataclasses.replace(SMALL_RIG, width_px=200)
CONFIG = CorrectionConfig(height_range_mm=(-30.0, 30.0))
ONE_STRIP = dataclasses.replace(CONFIG, strip_rows=10_000)
FLAWLESS_RAIL = SceneConfig(
    kind="rail", rail_rise_mm=22.0, conveyor_drop_mm=26.0, defect_spacing_mm=0.0, roll_mark_period_mm=0.0
)
LOG = (torch.arange(LINES) * PITCH + 0.5 * torch.sin(torch.arange(LINES) / 9.0)).double()
MOTIONS = {
    "nominal": ((0.0, 1.0, 0.0), Travel(PITCH)),
    "askew": ((-0.03, 0.98, 0.05), Travel(PITCH)),
    "stretched": ((0.0, 1.0246, 0.0), Travel(PITCH)),
    "reverse": ((0.03, 1.01, -0.02), Travel(PITCH, None, "reverse")),
    "encoder": ((-0.02, 1.01, 0.01), Travel(PITCH, LOG)),
    "reverse encoder": ((-0.02, 1.01, 0.01), Travel(PITCH, LOG, "reverse")),
}


def scan_of(depth: Tensor, travel: Travel, rig: Rig = RIG) -> Scan:
    color = torch.randint(1, 256, (*depth.shape, 3)).to(torch.uint8)
    return Scan(Path("plane"), rig, travel, DepthView(TensorImage(color), TensorImage(depth.float()[..., None])))


def flat(depth: float = DEPTH) -> Tensor:
    return torch.full((LINES, RIG.width_px), depth)


def model_source(grid, motion: Motion, travel: Travel, depth: float) -> tuple[Tensor, Tensor]:
    """(line, column) at which each cell of a product sees a surface of constant depth, by the model alone."""
    rows, columns = torch.arange(grid.rows).double()[:, None], torch.arange(grid.columns).double()
    q_x = grid.origin_x_mm + grid.pitch_mm * columns
    q_y = grid.origin_y_mm + grid.pitch_mm * rows
    e_x, e_y, _ = product_axes(motion.n)
    x = (q_x - depth * e_x[2]) / e_x[0]
    y = (q_y - x * e_y[0] - depth * e_y[2]) / torch.linalg.vector_norm(motion.n)
    column = RIG.principal_left_px + x / depth * focal_length_px(RIG)
    return line_at(travel, y), column.expand(grid.rows, -1)


@pytest.mark.parametrize("case", MOTIONS)
def test_source_and_height_of_a_plane_agree_with_the_model(case):
    n, travel = MOTIONS[case]
    motion, scan = motion_of(*n), scan_of(flat(), travel)
    grid = plan_product(scan, motion, CONFIG)
    true_line, true_column = model_source(grid, motion, travel, DEPTH)
    beyond = [true_line, LINES - 1 - true_line, true_column, RIG.width_px - 1 - true_column]
    margin = torch.stack(beyond).amin(0)
    inside, on_rim = margin > 1e-6, margin.abs() <= 1e-6

    (strip,) = correct_scan(scan, depth_of(scan), motion, dataclasses.replace(CONFIG, strip_rows=grid.rows))
    assert torch.equal(strip.valid[~on_rim], inside[~on_rim])
    assert torch.equal(strip.height.isfinite(), strip.valid)
    for part, true in enumerate((true_line, true_column)):
        off = (strip.source[inside][:, part].double() - true[inside]).abs()
        assert (off <= 0.5 / PIXEL_PARTS + 1e-6 + 1e-6 * true[inside]).all()  # the map tells what was sampled
    _, _, e_z = product_axes(motion.n)
    x = (true_column - RIG.principal_left_px) / focal_length_px(RIG) * DEPTH
    middle = torch.tensor([RIG.baseline_mm / 2, 0.0, zero_disparity_mm(RIG)], dtype=torch.float64)
    height = e_z @ middle - (x * e_z[0] + DEPTH * e_z[2])
    assert (strip.height.double() - height)[inside].abs().max() < 1e-4


def test_nominal_product_of_the_zero_plane_is_the_scan():
    # On the plane of zero disparity a cell of one pixel's width on the object is one pixel of the image.
    pitch = object_pitch_mm(RIG)
    z0 = zero_disparity_mm(RIG)
    scan = scan_of(flat(z0).double(), Travel(pitch))
    motion = motion_of(0.0, 1.0, 0.0)
    grid = plan_product(scan, motion, CONFIG)
    grid = dataclasses.replace(
        grid, origin_x_mm=-RIG.principal_left_px * pitch, columns=RIG.width_px - 1, rows=LINES - 1
    )
    strip = Correction(scan, depth_of(scan), motion, CONFIG, grid).strip((1, LINES - 1))
    interior = (slice(0, -1), slice(1, -1))
    assert (strip.color.int() - scan.left.tensor[1:-1, :-1].int())[interior].abs().max() <= 1
    assert strip.height[interior].abs().max() < 1e-4


@pytest.mark.parametrize("case", ["nominal", "askew", "reverse encoder"])
def test_strips_change_no_bit(case):
    n, travel = MOTIONS[case]
    motion = motion_of(*n)
    depth = DEPTH + 6 * torch.sin(torch.arange(LINES)[:, None] / 25.0) + 0.02 * torch.arange(RIG.width_px)
    depth[40:60, 80:120] -= 15.0
    depth[torch.rand(depth.shape) < 0.02] = torch.nan
    scan = scan_of(depth, travel)
    grid = plan_product(scan, motion, CONFIG)

    def product(rows: int) -> list[Tensor]:
        strips = list(correct_scan(scan, depth_of(scan), motion, dataclasses.replace(CONFIG, strip_rows=rows)))
        assert [strip.row for strip in strips] == list(range(0, grid.rows, rows))
        return [torch.cat([getattr(s, part) for s in strips]) for part in ("color", "height", "valid", "source")]

    whole = product(grid.rows)
    assert whole[2].float().mean() > 0.3
    for rows in (7, 64):
        for part, expected in zip(product(rows), whole, strict=True):
            torch.testing.assert_close(part, expected, rtol=0, atol=0, equal_nan=True)


def stepped(near_on_the_right: bool) -> Tensor:
    depth = flat(800.0)
    near = slice(180, None) if near_on_the_right else slice(None, 120)
    depth[:, near] = 780.0
    return depth


def test_at_a_step_the_nearer_surface_wins():
    # Right of the camera a nearer surface stands over what is behind it.
    motion = motion_of(0.0, 1.0, 0.0)
    scan = scan_of(stepped(near_on_the_right=True), Travel(PITCH))
    grid = plan_product(scan, motion, CONFIG)
    strip = Correction(scan, depth_of(scan), motion, CONFIG, grid).strip((40, 80))
    q_x = grid.origin_x_mm + grid.pitch_mm * torch.arange(grid.columns).double()
    edge_near, edge_far = (
        (k - RIG.principal_left_px) / focal_length_px(RIG) * z for k, z in ((180, 780.0), (179, 800.0))
    )
    assert edge_near < edge_far - grid.pitch_mm
    high = zero_disparity_mm(RIG) - 780.0
    both = (q_x > edge_near) & (q_x < edge_far)
    assert both.any()
    torch.testing.assert_close(strip.height[:, both], torch.full_like(strip.height[:, both], high), rtol=0, atol=1e-4)
    assert set(strip.height[strip.valid].sub(zero_disparity_mm(RIG) - 790.0).sign().tolist()) == {-1.0, 1.0}
    heights = strip.height[strip.valid]
    assert (((heights - high).abs() < 1e-3) | ((heights - high + 20).abs() < 1e-3)).all()  # nothing in between


def test_behind_a_step_nothing_is_interpolated():
    motion = motion_of(0.0, 1.0, 0.0)
    scan = scan_of(stepped(near_on_the_right=False), Travel(PITCH))
    grid = plan_product(scan, motion, CONFIG)
    strip = Correction(scan, depth_of(scan), motion, CONFIG, grid).strip((40, 80))
    q_x = grid.origin_x_mm + grid.pitch_mm * torch.arange(grid.columns).double()
    edge_near, edge_far = (
        (k - RIG.principal_left_px) / focal_length_px(RIG) * z for k, z in ((119, 780.0), (120, 800.0))
    )
    hidden = (q_x > edge_near) & (q_x < edge_far)
    assert hidden.sum() >= 2
    assert not strip.valid[:, hidden].any()
    assert strip.source[:, hidden].isnan().all()
    assert (strip.color[:, hidden] == 0).all()


def test_a_step_along_the_motion_is_not_interpolated():
    motion = motion_of(0.0, 0.99, 0.1)
    depth = flat(800.0)
    depth[75:] = 780.0
    scan = scan_of(depth, Travel(PITCH))
    (strip,) = correct_scan(scan, depth_of(scan), motion, dataclasses.replace(CONFIG, strip_rows=1000))
    line = strip.source[..., 0]
    between = (line > 74.001) & (line < 74.999)
    assert not between.any()


def test_small_holes_are_bridged_for_colour_alone():
    motion = motion_of(0.0, 1.0, 0.0)
    config = dataclasses.replace(CONFIG, strip_rows=1000, pitch_mm=1.1)  # no cell exactly on a line
    depth = flat()
    depth[50:60, 90:100] = torch.nan
    depth[50:60, 130:180] = torch.nan  # wider than bridge_px
    scan = scan_of(depth, Travel(PITCH))
    full = scan_of(flat(), Travel(PITCH))
    (strip,) = correct_scan(scan, depth_of(scan), motion, config)
    line, column = strip.source.unbind(-1)
    (unharmed,) = correct_scan(full, depth_of(full), motion, config)
    across, along = unharmed.source[..., 1], unharmed.source[..., 0]
    in_lines = (along > 49) & (along < 60)
    small = in_lines & (across > 89) & (across < 100)
    large = in_lines & (across > 129) & (across < 180)
    assert small.any()
    assert torch.isfinite(line[small]).all()
    torch.testing.assert_close(column[small], across[small], rtol=0, atol=1e-4)
    assert not strip.valid[small].any()
    assert strip.height[small].isnan().all()
    assert line[large].isnan().all()
    elsewhere = ~small & ~large
    torch.testing.assert_close(strip.height[elsewhere], unharmed.height[elsewhere], equal_nan=True)


@pytest.mark.parametrize("case", MOTIONS)
def test_the_grid_holds_the_whole_field(case):
    n, travel = MOTIONS[case]
    motion, scan = motion_of(*n), scan_of(flat(), travel)
    grid = plan_product(scan, motion, CONFIG)
    u = torch.tensor([0.0, RIG.width_px - 1.0]).double()
    for height in CONFIG.height_range_mm:
        z = zero_disparity_mm(RIG) - height
        for line in (0.0, LINES - 1.0):
            x = (u - RIG.principal_left_px) / focal_length_px(RIG) * z
            y = travel_at(travel, torch.full_like(u, line))
            q = to_product(torch.stack([x, y, torch.full_like(x, z)], -1), motion.n)
            row, column = (q[:, 1] - grid.origin_y_mm) / PITCH, (q[:, 0] - grid.origin_x_mm) / PITCH
            assert (row > -1e-6).all()
            assert (row < grid.rows).all()
            assert (column > -1e-6).all()
            assert (column < grid.columns).all()


@dataclasses.dataclass(frozen=True)
class Unreadable:
    """An image of ten million lines that nobody may read."""

    shape: tuple[int, int, int] = (10_000_000, RIG.width_px, 3)
    dtype: torch.dtype = torch.uint8

    def read(self, start: int, stop: int) -> Tensor:
        raise AssertionError("planning reads no pixel")


def test_planning_a_long_scan_reads_nothing():
    scan = Scan(Path("long"), RIG, Travel(PITCH), DepthView(Unreadable(), Unreadable()))
    motion = motion_of(0.02, 1.0, 0.01)
    grid = plan_product(scan, motion, CONFIG)
    assert abs(grid.rows - 1e7 * motion.stretch) < 100
    assert grid.pitch_mm == PITCH
    halved = plan_product(scan, motion, dataclasses.replace(CONFIG, pitch_mm=PITCH / 2))
    assert abs(halved.rows - 2 * grid.rows) <= 1
    assert abs(halved.columns - 2 * grid.columns) <= 1
    with pytest.raises(ConfigError, match=r"CorrectionConfig\.pitch_mm"):
        dataclasses.replace(CONFIG, pitch_mm=0.0)


def test_rows_beyond_the_scan_are_empty():
    motion = motion_of(0.0, 1.0, 0.0)
    scan = scan_of(flat(), Travel(PITCH))
    grid = dataclasses.replace(plan_product(scan, motion, CONFIG), rows=10_000)
    strip = Correction(scan, depth_of(scan), motion, CONFIG, grid).strip((5000, 5003))
    assert strip.color.shape == (3, grid.columns, 3)
    assert not strip.valid.any()
    assert strip.height.isnan().all()
    assert strip.source.isnan().all()


@pytest.mark.parametrize("resampler", ["grid_sample", pytest.param("opencv", marks=pytest.mark.slow)])
def test_an_overview_of_many_lines_a_cell_is_the_same_in_any_strips(resampler):
    lines, pitch, narrow = 12_000, 20 * PITCH, dataclasses.replace(RIG, width_px=100)
    motion, scan = (
        motion_of(0.03, 1.01, -0.02),
        scan_of(torch.full((lines, narrow.width_px), DEPTH), Travel(PITCH), narrow),
    )
    config = dataclasses.replace(CONFIG, pitch_mm=pitch, resampler=resampler)
    made = []
    for rows in (64, 10_000):
        strips = list(correct_scan(scan, depth_of(scan), motion, dataclasses.replace(config, strip_rows=rows)))
        made.append(torch.cat([strip.color for strip in strips]))
    assert len(made[0]) > 500
    assert torch.equal(*made)
    assert (made[0] > 0).any()


@pytest.mark.parametrize("angles", [(0.0, 0.0), (2.0, 1.5), (-3.0, 3.0), (3.0, -3.0)])
def test_heights_count_from_the_middle_of_zero_disparity(angles):
    """A rail 22 mm before that point reads 22.00, the conveyor 26 mm behind it -26.00, at any skew of the motion."""
    motion = MotionConfig(angle_x_deg=angles[0], angle_z_deg=angles[1], stretch=1.0246)
    source = simulate(
        SMALL_RIG, BOARD, FLAWLESS_RAIL, motion, SensorConfig(supersampling=1), Acquisition(PITCH, lines=120)
    )
    scan = depth_scan(source)
    (strip,) = correct_scan(scan, depth_of(scan), Motion(source.trajectory.n, torch.zeros(3, 3).double()), ONE_STRIP)
    heights = strip.height[strip.valid]
    assert heights.max() == pytest.approx(FLAWLESS_RAIL.rail_rise_mm, abs=0.005)
    assert heights.median() == pytest.approx(-FLAWLESS_RAIL.conveyor_drop_mm, abs=0.005)
