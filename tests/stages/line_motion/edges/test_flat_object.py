"""Where a flat object lies on lines, and which piece of a profile it is."""

import pytest
import torch

from lsvision.geometry import ProductFrame
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.profiles import Reference, reference_of
from lsvision.types import LineMotion
from tests.stages.line_motion.edges.drawn import FRAME, RIG

NODES = torch.arange(600).double()


def profile(slope: float = 0.03, bend_mm: float = 0.0) -> Reference:
    """A conveyor, a sheet over it from node 150 to 450, and the conveyor again."""
    height = torch.full_like(NODES, -26.0)
    height[150:450] = -5.0 + 0.5 * slope * NODES[150:450] + bend_mm * ((NODES[150:450] - 300) / 150).square()
    found = reference_of(10.0, 0.5, height + 0.005 * torch.randn(600, generator=torch.Generator().manual_seed(0)))
    assert found is not None
    return found


def test_the_object_is_the_widest_piece_between_steps() -> None:
    flat = FlatObject.of(profile(), FRAME)
    assert flat is not None
    assert flat.slope == pytest.approx(0.03, abs=1e-4)
    assert flat.height_mm == pytest.approx(-5.0 - 10.0 * 0.03, abs=0.01)
    assert 10.0 + 75.0 <= flat.low_mm < 10.0 + 77.0
    assert 10.0 + 223.0 < flat.high_mm <= 10.0 + 225.0
    assert int(flat.profile.height.isfinite().sum()) == pytest.approx(300, abs=4)
    assert not flat.profile.slope.nan_to_num().any()


def test_what_is_not_flat_is_none() -> None:
    assert FlatObject.of(profile(bend_mm=3.0), FRAME) is None
    nothing = torch.full((600,), torch.nan).double()
    assert FlatObject.of(Reference(0.0, 0.5, nothing, nothing), FRAME) is None


def test_places_and_columns_are_inverse_on_lines_that_move() -> None:
    flat = FlatObject.of(profile(), FRAME)
    assert flat is not None
    motion = torch.tensor([[0.5, -0.3, 2e-3, 0.0], [-0.4, 0.6, -1e-3, 0.0]]).double()
    q_x = torch.tensor([[100.0, 120.0], [200.0, 180.0], [95.0, 230.0]]).double()
    columns = flat.columns(q_x, motion)
    torch.testing.assert_close(flat.across(columns[0], motion), q_x, rtol=0, atol=1e-9)


def test_columns_are_where_the_product_frame_sees_them() -> None:
    flat = FlatObject.of(profile(), FRAME)
    assert flat is not None
    motion = torch.tensor([[0.5, -0.3, 2e-3, 0.0], [-0.4, 0.6, -1e-3, 0.0]]).double()
    frame = ProductFrame(RIG, FRAME.travel, FRAME.n, LineMotion(motion, torch.zeros(2, 4, 4).double()))
    q_x, line = torch.tensor([120.0, 180.0]).double(), torch.arange(2).double()
    q_z = frame.height_datum_mm - flat.height_mm - flat.slope * q_x
    z = frame.shown_on_lines(torch.stack([q_x, q_z], -1), motion)[:, 1]
    found = frame.position(flat.columns(q_x, motion)[0], line, z)
    torch.testing.assert_close(found[:, 0], q_x, rtol=0, atol=1e-9)
    torch.testing.assert_close(found[:, 2], q_z, rtol=0, atol=1e-9)
