"""Motion from line to line: the exact formulas against the renderer's, their inverses and derivatives, the gauge."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import (
    ProductFrame,
    displace,
    middle_point,
    product_axes,
    project,
    shaken,
    steadied,
    steadied_jacobian,
    travel_at,
    uneven_travel,
    without_trend,
    zero_disparity_mm,
)
from lsvision.simulation import EncoderConfig, MotionConfig, Trajectory
from lsvision.types import LINE_COMPONENTS, LineFinding, LineMotion, Travel
from tests.geometry.test_product import LINES, PITCH, RIG, TRAVELS, frame_of, samples

SHAKEN = MotionConfig(-1.5, 0.8, 1.0246, vibration_x_mm=0.7, vibration_z_mm=0.4, vibration_roll_deg=0.3)


def random_motion(lines: int = LINES, dy_mm: float = 0.0) -> LineMotion:
    """Jumps from line to line, much larger than any rail's."""
    scale = torch.tensor([0.7, 0.7, math.radians(0.5), dy_mm], dtype=torch.float64)
    root = torch.randn(lines, 4, 4, dtype=torch.float64) * scale[:, None]
    return LineMotion(torch.rand(lines, 4, dtype=torch.float64) * 2 * scale - scale, root @ root.mT)


def shaken_frame(travel: str = "constant", dy_mm: float = 0.0) -> ProductFrame:
    return dataclasses.replace(frame_of(travel), line_motion=random_motion(dy_mm=dy_mm))


def test_batch_equals_loop() -> None:
    points, motion, pivot = torch.randn(5, 1, 2).double() * 100, random_motion(7).values, middle_point(RIG)
    for function in (shaken, steadied, lambda *at: steadied_jacobian(*at).flatten(-2)):
        batched = function(points, motion, pivot)
        for i, j in ((0, 0), (4, 6), (2, 3)):
            assert torch.equal(batched[i, j], function(points[i, 0], motion[j], pivot))


def test_a_quarter_turn_by_hand() -> None:
    """Roll turns Z towards X: what lay 10 mm behind c lies 10 mm beside it, then it is displaced."""
    pivot, motion = middle_point(RIG), torch.tensor([1.0, 2.0, math.pi / 2, 9.0], dtype=torch.float64)
    found = shaken(pivot[::2] + torch.tensor([0.0, 10.0]).double(), motion, pivot)
    torch.testing.assert_close(found - pivot[::2], torch.tensor([11.0, 2.0]).double(), rtol=0, atol=1e-10)


def test_steadied_is_the_inverse_and_has_its_derivative() -> None:
    points, motion, pivot = torch.randn(300, 2).double() * 100, random_motion(300).values, middle_point(RIG)
    torch.testing.assert_close(steadied(shaken(points, motion, pivot), motion, pivot), points, rtol=0, atol=1e-10)
    by_motion = jacobian(lambda at: steadied(points[0], at, pivot), motion[0])
    found = steadied_jacobian(steadied(points[0], motion[0], pivot), motion[0], pivot)
    torch.testing.assert_close(found, by_motion[:, :3], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("travel", TRAVELS)
def test_frame_equals_the_matrix_form(travel: str) -> None:
    """q = (e_x, e_y, e_z)ᵀ p with p = Ry(ρ)ᵀ (P - c - (δx, 0, δz)) + c + y n, every sample by itself."""
    frame, (column, line, z) = shaken_frame(travel, dy_mm=0.005), samples(60)
    line = line.round()
    c = middle_point(RIG)
    x = (column - RIG.principal_left_px) / RIG.focal_length_mm * RIG.pixel_pitch_um * 1e-3 * z
    expected = []
    for i, (dx, dz, roll, dy) in enumerate(frame.line_motion.values[line.long()].tolist()):
        cos, sin = math.cos(roll), math.sin(roll)
        turn = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]], dtype=torch.float64)
        seen = torch.stack([x[i], torch.zeros(()).double(), z[i]])
        y = travel_at(frame.travel, line[i]) + dy
        p = turn.mT @ (seen - c - seen.new_tensor([dx, 0.0, dz])) + c + y * frame.n
        expected.append(product_axes(frame.n) @ p)
    q = frame.position(column, line, z)
    torch.testing.assert_close(q, torch.stack(expected), rtol=0, atol=1e-10)
    relief = zero_disparity_mm(RIG) - q[:, 2]
    torch.testing.assert_close(frame.q_y(frame.along(line), q[:, 0], relief), q[:, 1], rtol=0, atol=1e-10)
    torch.testing.assert_close(frame.depth(column, relief, line), z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("travel", TRAVELS)
def test_round_trip(travel: str) -> None:
    frame, (column, line, z) = shaken_frame(travel, dy_mm=0.005), samples()
    source = frame.source(frame.position(column, line, z))
    torch.testing.assert_close(source, torch.stack([column, line, z], -1), rtol=0, atol=1e-6)
    low, high = frame.offset_range(frame.position(column, line, z)[:, 0], z)
    offset = frame.position(column, line, z)[:, 1] - frame.along(line)
    assert low <= offset.min()
    assert offset.max() <= high


def test_no_motion_is_no_motion() -> None:
    still = LineMotion(torch.zeros(LINES, 4).double(), torch.zeros(LINES, 4, 4).double())
    frame, (column, line, z) = frame_of(), samples()
    found = dataclasses.replace(frame, line_motion=still).position(column, line, z)
    torch.testing.assert_close(found, frame.position(column, line, z), rtol=0, atol=1e-11)
    assert still.is_still
    assert uneven_travel(frame.travel, still) is frame.travel


def test_displacement_jacobian() -> None:
    frame, (column, line, z) = shaken_frame(), samples(3)
    line = line.round()

    def position(values: Tensor) -> Tensor:
        changed = frame.line_motion.values.clone().index_copy(0, line[:1].long(), values[None])
        moved = LineMotion(changed, frame.line_motion.covariance)
        return dataclasses.replace(frame, line_motion=moved).position(column[:1], line[:1], z[:1])[0]

    values, step = frame.line_motion.values[line[0].long()], 1e-6 * torch.eye(4).double()
    differences = torch.stack([(position(values + d) - position(values - d)) / 2e-6 for d in step], dim=-1)
    found = frame.displacement_jacobian(column, line, z)[0]
    torch.testing.assert_close(found, differences, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="line_motion"):
        frame_of().displacement_jacobian(column, line, z)


@pytest.mark.parametrize("transport", ["forward", "reverse"])
def test_equals_the_renderer(transport: str) -> None:
    """Points of the object, projected by the renderer's trajectory, come back as themselves, in raw colours too."""
    trajectory = Trajectory(RIG, SHAKEN, EncoderConfig(), PITCH, transport)
    points = torch.randn(200, 3, dtype=torch.float64) * 20 + torch.tensor([170.0, 14.0, 790.0])
    points[:, 1] *= trajectory.sign
    lines = torch.arange(-3000, 6000).double()
    truth = LineMotion(torch.nn.functional.pad(trajectory.vibration(lines), (0, 1)), torch.zeros(len(lines), 4, 4))
    # Lines are counted from the first: the travel of the log begins 3000 lines before the renderer's.
    travel = Travel(PITCH, PITCH * lines, transport)
    frame = ProductFrame(RIG, travel, trajectory.n, truth)
    x, line, z = trajectory.project(points).unbind(-1)
    column, _ = project(RIG, x, z)
    found = frame.position(column, line + 3000, z)
    # Between two lines the motion is taken as linear.
    torch.testing.assert_close(found, points @ product_axes(frame.n).mT, rtol=0, atol=1e-5)

    shift = torch.tensor(4 * PITCH, dtype=torch.float64)
    later = frame.shifted_line(line + 3000, shift)
    shifted = frame.shifted_column(column, z, shift, (line + 3000, later))
    # In a plane Y = shift the renderer shows a point as if the object lay nearer by the shift.
    y = (points[:, 1] - shift) / frame.n[1]
    moved = displace(torch.stack([torch.zeros_like(y), -y, torch.zeros_like(y)], -1), frame.n) + points
    motion = frame.line_motion.at(later)
    expected, _ = project(RIG, *shaken(moved[:, ::2], motion, middle_point(RIG)).unbind(-1))
    torch.testing.assert_close(shifted, expected, rtol=0, atol=1e-3)


def test_gauge_has_neither_mean_nor_trend() -> None:
    along = travel_at(TRAVELS["reverse encoder"], torch.arange(LINES).double())
    remove, values = without_trend(along), torch.randn(2, 3, LINES).double()
    found = remove(values + 3.0 + 0.2 * along)
    torch.testing.assert_close(found, remove(values), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.mean(-1), torch.zeros(2, 3).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close((found * along).mean(-1), torch.zeros(2, 3).double(), rtol=0, atol=1e-10)
    assert torch.equal(without_trend(along[:1])(values[..., :1]), torch.zeros(2, 3, 1).double())


def test_gauge_of_the_lines_that_were_measured() -> None:
    along, values = torch.arange(LINES).double(), torch.randn(3, LINES).double()
    some = along < LINES // 2
    found = without_trend(along, some)(values)
    torch.testing.assert_close(found[:, some], without_trend(along[some])(values[:, some]), rtol=0, atol=1e-12)
    removed = values - found
    torch.testing.assert_close(removed.diff(n=2), torch.zeros(3, LINES - 2).double(), rtol=0, atol=1e-12)


def test_uneven_travel_keeps_the_order_of_lines() -> None:
    motion = random_motion(dy_mm=1.0)
    with pytest.raises(ValueError, match="dy_mm must leave the lines in their order"):
        uneven_travel(TRAVELS["constant"], motion)
    gentle = dataclasses.replace(motion, values=motion.values * torch.tensor([1, 1, 1, 0.01]).double())
    for travel in TRAVELS.values():
        line = torch.arange(LINES).double()
        expected = travel_at(travel, line) + gentle.dy_mm
        torch.testing.assert_close(travel_at(uneven_travel(travel, gentle), line), expected, rtol=0, atol=1e-12)


def test_findings_in_words() -> None:
    assert LineFinding("dx", "absent", sigma=0.07).in_words == "sideways: nothing above the errors of a line, 0.07 mm"
    found = LineFinding("roll", "corrected", math.radians(0.02), math.radians(0.005), 60.0, 300.0)
    assert found.in_words == "roll: 0.02 deg rms, known to 0.005 deg, over lengths of 60 mm"
    unseen = LineFinding("dx", "not observed", sigma=0.5).in_words
    assert unseen == "sideways: not observed, the object's shape does not show it better than to 0.5 mm"
    assert LineFinding("dz", "not observed", reason="why").in_words == "in depth: not observed, why"
    motion = random_motion(3)
    parts = torch.stack([motion.dx_mm, motion.dz_mm, motion.roll_rad, motion.dy_mm], -1)
    assert torch.equal(parts, motion.values)
    assert motion.sigma.shape == (motion.lines, len(LINE_COMPONENTS))
    assert motion.at(torch.tensor([0.5, torch.nan]).double())[1].isnan().all()
    middle = motion.at(torch.tensor(0.5).double())
    torch.testing.assert_close(middle, motion.values[:2].mean(0))
