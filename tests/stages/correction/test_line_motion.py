"""Products of shaken objects whose motion from line to line is known: they are those of the object at rest."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import pad

from lsvision.geometry import ProductFrame
from lsvision.io import read_scan
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    Trajectory,
    simulate,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.uncertainty import position_sigma
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, LineMotion, Motion, ProductStrip, Scan, TensorImage, Travel
from tests.stages.rendered import BOARD, PITCH, SMALL_RIG, depth_scan

STILL = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
SHAKEN = dataclasses.replace(
    STILL,
    vibration_x_mm=0.65,
    vibration_z_mm=0.65,
    vibration_roll_deg=0.2,
    vibration_wavelengths_mm=(233.0, 97.0, 61.0),
)
RAIL = SceneConfig(kind="rail", defect_spacing_mm=0.0, roll_mark_period_mm=0.0)
SHEET = SceneConfig(kind="sheet", yaw_deg=3.0, sheet_height_mm=120.0, texture_mm=2.0)
N = Trajectory(SMALL_RIG, STILL, EncoderConfig(), PITCH).n
CONFIG = CorrectionConfig(height_range_mm=(-40.0, 40.0), strip_rows=1000)


def rendered(scene: SceneConfig, motion: MotionConfig, spacing: float = 0.0, lines: int | None = None) -> Simulation:
    rig = dataclasses.replace(SMALL_RIG, color_spacing_lines=(-spacing, 0.0, spacing))
    sensor = SensorConfig(supersampling=1, noise=0.0)
    return simulate(rig, BOARD, scene, motion, sensor, Acquisition(PITCH, lines=lines))


def true_motion(scan: Scan) -> LineMotion:
    """The vibration that a scan was rendered with, known exactly."""
    trajectory = Trajectory(SMALL_RIG, SHAKEN, EncoderConfig(), PITCH)
    values = pad(trajectory.vibration(torch.arange(scan.lines).double()), (0, 1))
    return LineMotion(values, torch.zeros(scan.lines, 4, 4, dtype=torch.float64))


@cache
def scan_of(scene: SceneConfig, motion: MotionConfig, spacing: float = 0.0, lines: int | None = None) -> Scan:
    return depth_scan(rendered(scene, motion, spacing, lines))


def product(scan: Scan, line_motion: LineMotion | None, config: CorrectionConfig = CONFIG) -> ProductStrip:
    motion = Motion(N, torch.zeros(3, 3, dtype=torch.float64))
    (strip,) = correct_scan(scan, depth_of(scan), motion, config, line_motion=line_motion)
    return strip


def crown(strip: ProductStrip) -> Tensor:
    """Height of the rail's crown by row."""
    highest = strip.height.nan_to_num(-1e9).amax(1)
    return highest[highest > 0][2:-2]


def test_the_crown_of_a_shaken_rail_stays_where_it_is() -> None:
    scan = scan_of(RAIL, SHAKEN, lines=240)
    before, after = (crown(product(scan, motion)) for motion in (None, true_motion(scan)))
    assert before.std() > 0.4
    assert after.std() < 0.002
    still, moved = product(scan_of(RAIL, STILL, lines=240), None), product(scan, true_motion(scan))
    both = still.valid & moved.valid
    assert both.float().mean() > 0.9 * still.valid.float().mean()
    off = (still.height - moved.height)[both].abs()
    assert off.median() < 0.002
    assert off.quantile(0.95) < 0.05  # steep flanks are interpolated over pixels of 1.1 mm


@pytest.mark.parametrize("spacing", [0.0, 0.75])
def test_a_shaken_sheet_shows_what_it_shows_at_rest(spacing: float) -> None:
    still, scan, plain = product(scan_of(SHEET, STILL), None), scan_of(SHEET, SHAKEN, spacing), scan_of(SHEET, SHAKEN)
    patch = (slice(50, 120), slice(170, 300))

    def difference(strip: ProductStrip) -> Tensor:
        return (strip.color[patch].float() - still.color[patch].float()).square().mean((0, 1)).sqrt()

    before, after = (difference(product(scan, motion)) for motion in (None, true_motion(scan)))
    assert (after < 0.4 * before).all()
    green = difference(product(plain, true_motion(plain)))[1]
    assert (after < 1.2 * green + 0.5).all()  # red and blue lie as well as green


def test_strips_change_no_bit() -> None:
    scan, motion = scan_of(SHEET, SHAKEN, 0.75), Motion(N, 1e-6 * torch.eye(3).double())
    made = []
    for rows in (1000, 37):
        config = dataclasses.replace(CONFIG, strip_rows=rows, uncertainty=True)
        strips = list(correct_scan(scan, depth_of(scan), motion, config, line_motion=true_motion(scan)))
        parts = ("color", "height", "valid", "source", "sigma")
        made.append([torch.cat([getattr(strip, part) for strip in strips]) for part in parts])
    for one, other in zip(*made, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_motion_of_nothing_leaves_every_bit() -> None:
    scan = scan_of(SHEET, STILL)
    nothing = LineMotion(torch.zeros(scan.lines, 4).double(), torch.zeros(scan.lines, 4, 4).double())
    config = dataclasses.replace(CONFIG, uncertainty=True)
    one, other = (product(scan, motion, config) for motion in (None, nothing))
    for part in ("color", "height", "source", "sigma"):
        torch.testing.assert_close(getattr(one, part), getattr(other, part), rtol=0, atol=0, equal_nan=True)


def test_its_uncertainty_equals_monte_carlo() -> None:
    generator = torch.Generator().manual_seed(1)
    scale = torch.tensor([0.1, 0.05, 1e-3, 0.02]).double()
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64) * scale[:, None]
    lines, n = 3, torch.tensor([-0.03, 1.02, 0.05]).double()
    values = (0.3 * torch.randn(4, generator=generator).double() * scale).expand(lines, 4)
    motion = LineMotion(values, (root @ root.mT).expand(lines, 4, 4))
    frame = ProductFrame(SMALL_RIG, Travel(PITCH), n, motion)
    column, line, z = (torch.tensor([value]).double() for value in (400.0, 1.0, 770.0))
    sigma = position_sigma(frame, torch.zeros(3, 3).double(), column, line, torch.zeros(1).double(), z)
    drawn = values[0] + torch.randn(100_000, 4, generator=generator, dtype=torch.float64) @ root.mT
    many = dataclasses.replace(frame, line_motion=LineMotion(pad(drawn[:, :3], (0, 1)), torch.zeros(len(drawn), 4, 4)))
    at = torch.arange(len(drawn)).double()
    places = many.position(column, at, z)
    places[:, 1] += frame.stretch * (drawn[:, 3] - PITCH * at)
    torch.testing.assert_close(sigma[0], places.std(0), rtol=0.015, atol=0)


def test_a_rail_of_the_other_renderer_lies_still(shared_data: Path) -> None:
    folder = shared_data / "scans_shaken_and_raw" / "shaken_rail"
    truth, by_line = json.loads((folder / "truth.json").read_text()), np.load(folder / "truth.npz")
    every, depth, given = int(by_line["z_every_lines"]), torch.from_numpy(by_line["z"]), read_scan(folder)
    values = np.stack([by_line[name][::every] for name in ("dx", "dz", "roll")], -1)
    shaken = LineMotion(pad(torch.from_numpy(values), (0, 1)), torch.zeros(len(depth), 4, 4).double())
    images = DepthView(TensorImage(torch.zeros(*depth.shape, 1, dtype=torch.uint8)), TensorImage(depth[..., None]))
    scan = Scan(folder, given.rig, Travel(every * given.travel.line_pitch_mm), images)
    motion = Motion(torch.tensor(truth["n"], dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64))

    def spread(line_motion: LineMotion | None) -> float:
        """Median over the columns of the rms of the height along them, mm."""
        config = dataclasses.replace(CONFIG, pitch_mm=0.5, strip_rows=10_000)
        (strip,) = correct_scan(scan, depth_of(scan), motion, config, line_motion=line_motion)
        height = torch.where(strip.height > -20, strip.height, torch.nan)[40:-60]
        height = height[:, height.isfinite().float().mean(0) > 0.9]
        off = height - height.nanmedian(0).values
        return float(off.square().nanmean(0).sqrt().median())

    assert spread(None) > 0.5
    assert spread(shaken) < 0.004
