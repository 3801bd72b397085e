"""Wear against a nominal section: how much metal is gone, where; another section is called one."""

from dataclasses import replace

import pytest
import torch

from lsvision.io import read_section
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.profile import profile_of
from lsvision.stages.surface.wear import worn
from tests.stages.surface.products import PITCH_MM, MemoryProduct, places, rail

SECTION, CONFIG = read_section("EN60E1"), LineMotionConfig()
ROWS, COLUMNS = 400, 400


def head(*, crown_mm=0.0, corner_mm=0.0, x_mm=0.7, noise_mm=0.005):
    """A head 60E1 beside the middle; so much is gone from its crown and its right gauge corner, along the normal."""
    outline = SECTION.outline
    q_x = places(ROWS, COLUMNS)[1] - x_mm
    level, slope = interpolated(q_x, outline)
    gone = crown_mm * (1 - (q_x / 12).square()).clamp(min=0)
    gone += corner_mm * (1 - ((q_x - 28) / 5).square()).clamp(min=0).sqrt()
    height = level - gone * (1 + slope.square()).sqrt()
    height = height.where(q_x.abs() < 34.5, torch.nan)
    noise = noise_mm * torch.randn(ROWS, COLUMNS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return MemoryProduct((height + noise).float(), torch.full((ROWS, COLUMNS, 1), 100, dtype=torch.uint8))


def interpolated(x, outline):
    after = torch.searchsorted(outline[:, 0].contiguous(), x).clamp(1, len(outline) - 1)
    (low, below), (high, above) = outline[after - 1].unbind(-1), outline[after].unbind(-1)
    slope = (above - below) / (high - low)
    return below + slope * (x - low), slope


def found(product):
    profile = profile_of(product, SurfaceConfig())
    (wear,) = worn(profile, SECTION, product.grid, 0.005, CONFIG)
    return wear


def test_a_new_head_is_not_worn():
    wear = found(head())
    assert wear.is_section
    assert wear.crown_mm == pytest.approx(0.0, abs=0.01)
    assert wear.left_corner_mm == pytest.approx(0.0, abs=0.02)
    assert wear.right_corner_mm == pytest.approx(0.0, abs=0.02)
    assert wear.last_mm - wear.first_mm == pytest.approx(ROWS * PITCH_MM)


@pytest.mark.parametrize(("crown_mm", "corner_mm"), [(0.3, 0.0), (0.0, 0.6), (0.2, 0.4)])
def test_what_is_worn_is_measured(crown_mm, corner_mm):
    wear = found(head(crown_mm=crown_mm, corner_mm=corner_mm))
    assert wear.is_section
    mean_of_crown = crown_mm * (1 - (10 / 12) ** 2 / 3)
    assert -wear.crown_mm == pytest.approx(mean_of_crown, abs=0.02)
    assert -wear.right_corner_mm == pytest.approx(corner_mm, abs=0.02 + 0.02 * corner_mm)
    assert -wear.left_corner_mm == pytest.approx(0.0, abs=0.02)


def test_another_section_is_called_one():
    assert not found(rail(400, columns=400)).is_section


def test_a_part_that_is_not_seen_has_no_figure():
    product = head()
    heights = product.heights.where(places(ROWS, COLUMNS)[1] < 15.0, torch.nan).float()
    wear = found(replace(product, heights=heights))
    assert wear.right_corner_mm is None
    assert wear.width_mm is None
