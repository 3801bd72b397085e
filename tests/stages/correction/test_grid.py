"""The size of products, the lines that their rows come from, and positions in scans of any length."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from lsvision.errors import FileFormatError
from lsvision.geometry import ProductFrame, zero_disparity_mm
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import Correction
from lsvision.stages.correction.grid import most_lines, plan_product, source_dtype
from lsvision.stages.correction.locate import Locator
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, Rig, Scan, Travel
from tests.stages.rendered import motion_of

RIG = Rig(64, 1120.0, 113.84, 354.0, 8.8, 54.0)
CONFIG = CorrectionConfig(height_range_mm=(-20.0, 20.0))


@dataclass(frozen=True)
class Endless:
    """An image of one value and any length, of which nothing is stored."""

    shape: tuple[int, int, int]
    value: float
    dtype: torch.dtype

    def read(self, start: int, stop: int) -> torch.Tensor:
        return torch.full((stop - start, *self.shape[1:]), self.value, dtype=self.dtype)


def scan_of(lines: int, travel: Travel, rig: Rig = RIG) -> Scan:
    left = Endless((lines, rig.width_px, 1), 100, torch.uint8)
    return Scan(Path("s"), rig, travel, DepthView(left, Endless(left.shape, zero_disparity_mm(rig), torch.float32)))


WOBBLING = Travel(7.8, 7.8 * torch.arange(500).double() + 3.0 * torch.sin(torch.arange(500).double() / 7))


@pytest.mark.parametrize("travel", [Travel(7.8), Travel(7.8, None, "reverse"), WOBBLING])
@pytest.mark.parametrize("n", [(0.0, 1.0246, 0.0), (0.2, 0.9, -0.3)])
@pytest.mark.parametrize("pitch_mm", [None, 2.0, 31.0])
def test_the_lines_of_strips_are_those_that_are_read(travel, n, pitch_mm):
    scan, motion = scan_of(500, travel), motion_of(*n)
    config = dataclasses.replace(CONFIG, pitch_mm=pitch_mm)
    grid, frame = plan_product(scan, motion, config), ProductFrame(scan.rig, scan.travel, motion.n)
    locator = Correction(scan, depth_of(scan), motion, config, grid).locator
    assert isinstance(locator, Locator)
    read = max(len(locator.lines_of((row, min(row + 32, grid.rows)), 10**9).along) for row in range(0, grid.rows, 32))
    assert 0 <= read - most_lines(frame, grid, config, 32) <= 7  # those to spare at either end


def test_stretch_is_no_skew():
    """70 000 lines of the full sensor, stretched by 2.46 %: a strip reads 512 rows' lines and few more."""
    rig = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
    scan, motion = scan_of(70_000, Travel(0.07), rig), motion_of(0.0, 1.0246, 0.0)
    grid = plan_product(scan, motion, CONFIG)
    assert grid.rows - scan.lines > 1700
    assert 499 <= most_lines(ProductFrame(rig, scan.travel, motion.n), grid, CONFIG, 512) <= 501


@pytest.mark.parametrize(
    ("n", "changes", "problem"),
    [
        ((0.0, 1e4, 0.0), {}, "of a travel and field of .* mm: do calibration and height_range_mm fit the scan"),
        ((0.0, 1.0, 1e9), {}, "of a travel and field of"),
        ((1e300, 1.0, 0.0), {}, "of a travel and field of"),
        ((0.0, 1.0, 0.0), {"height_range_mm": (-1e6, 60.0)}, "of a travel and field of"),
        ((0.0, 1.0, 0.0), {"pitch_mm": 1e-300}, "more than 1000 cells of 1e-300 mm for each pixel: is the pitch right"),
        ((0.0, 1.0, 0.0), {"pitch_mm": 1e300}, "less than a cell of 1e[+]300 mm: is the pitch right"),
        ((0.0, 1.0, 0.0), {"pitch_mm": 1e-4}, "more than 1000 cells of 0.0001 mm for each pixel: is the pitch right"),
    ],
)
def test_an_extent_that_no_scan_has(n, changes, problem):
    with pytest.raises(FileFormatError, match=f"s: its product would be .* x .* mm large, {problem}") as raised:
        plan_product(scan_of(500, Travel(7.8)), motion_of(*n), dataclasses.replace(CONFIG, **changes))
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize(("lines", "dtype"), [(65_536, torch.float32), (65_537, torch.float64)])
def test_the_type_of_positions(lines, dtype):
    assert source_dtype(lines) == dtype


def test_positions_are_as_fine_at_a_million_lines_as_at_the_start():
    lines, motion = 10**6, motion_of(0.01, 1.0246, 0.0)
    scan, config = scan_of(lines, Travel(7.8)), dataclasses.replace(CONFIG, strip_rows=64)
    correction = Correction(scan, depth_of(scan), motion, config, plan_product(scan, motion, config))
    rows = correction.grid.rows // 64 * 64 - 64, correction.grid.rows // 64 * 64
    strip = correction.strip(rows)
    frame, grid = correction.frame, correction.grid
    across, along = torch.meshgrid(
        grid.q_x(slice(0, grid.columns)), grid.q_y(0) + grid.pitch_mm * torch.arange(*rows).double(), indexing="xy"
    )
    q = torch.stack([across, along, torch.full_like(along, float("nan"))], -1)
    inner = strip.valid[:, 2:-2].all(1).nonzero()[:, 0]
    assert len(inner) > 30
    z = frame.depth(strip.source[..., 1].double(), -frame.height_over_relief_mm + strip.height.double())
    place = frame.position(strip.source[..., 1].double(), strip.source[..., 0], z)
    off = (place - q)[inner, 2:-2, 1].abs() / frame.advance_mm
    assert strip.source.dtype == torch.float64
    assert strip.source[..., 0].nan_to_num().max() > 999_000
    assert off.max() < 1 / 1024  # of a line; a position of single precision is off by up to 1/32
