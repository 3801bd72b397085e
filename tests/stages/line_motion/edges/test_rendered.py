"""δx of rendered sheets and of another renderer's board from their straight edges, matched from their images."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lsvision.archive.line_motion import DepthAlone
from lsvision.geometry import scaled_rig, without_trend
from lsvision.io import read_scan
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.measure import measure_line_motion
from lsvision.types import LineMotion, Motion, Scan, StereoPair, TensorImage
from tests.stages.rendered import BOARD, FULL_RIG

pytestmark = pytest.mark.slow

STILL = MotionConfig(angle_x_deg=2.0, angle_z_deg=1.5, stretch=1.0246)
SHEET = SceneConfig(kind="sheet", pitch_deg=2.0, roll_deg=1.5)


def measured(scan: Scan, n: Tensor) -> LineMotion:
    depth = DepthAlone(depth_of(scan, DisparityConfig(), n=n))
    return measure_line_motion(scan, depth, Motion(n, torch.zeros(3, 3).double()), LineMotionConfig()).motion


def rendered(scene: SceneConfig, motion: MotionConfig) -> tuple[Simulation, Scan]:
    source = simulate(scaled_rig(FULL_RIG, 4), BOARD, scene, motion, SensorConfig(seed=scene.seed), Acquisition(0.28))
    left, right = (TensorImage(torch.cat(list(source.strips(camera)))) for camera in ("left", "right"))
    return source, Scan(Path("sheet"), source.rig, source.travel, StereoPair(left, right))


def errors(found: LineMotion, truth: Tensor) -> Tensor:
    """Errors of δx and δz, mm, and of δx in units of its standard deviation, rms on lines that show the object.

    Mean and trend are no error of them, but for the trend of δx where it follows from its waves.
    """
    sigma = found.sigma[:, 0]
    shown = sigma < 2 * sigma.median()
    off = (found.values[:, :2] - truth).T
    error = without_trend(torch.arange(found.lines).double(), shown)(off)[:, shown]
    if found.findings[0].waves:
        error[0] = off[0, shown] - off[0, shown].mean()
    return torch.cat([error, error[:1] / sigma[shown]]).square().mean(1).sqrt()


@pytest.mark.parametrize(
    ("x_mm", "yaw_deg", "frame", "edges"), [(0.65, 0.0, True, 4), (0.3, -1.5, False, 2)], ids=["frame", "outlines"]
)
def test_a_shaken_sheet_is_known_as_well_as_its_sigma_says(
    x_mm: float, yaw_deg: float, frame: bool, edges: int
) -> None:
    motion = dataclasses.replace(STILL, vibration_x_mm=x_mm, vibration_z_mm=0.5, vibration_roll_deg=0.02)
    source, scan = rendered(dataclasses.replace(SHEET, yaw_deg=yaw_deg, sheet_frame=frame), motion)
    found = measured(scan, source.trajectory.n)
    sideways, deep, over_sigma = errors(found, source.trajectory.vibration(torch.arange(scan.lines))[:, :2]).tolist()
    assert (found.findings[0].state, found.findings[0].edges) == ("corrected", edges)
    assert found.findings[0].waves >= 3
    assert sideways < 0.05
    assert deep < 0.01
    assert 0.75 < over_sigma < 1.3


def test_a_still_sheet_keeps_every_bit() -> None:
    source, scan = rendered(dataclasses.replace(SHEET, yaw_deg=1.0, seed=2), STILL)
    found = measured(scan, source.trajectory.n)
    assert found.is_still
    assert [finding.state for finding in found.findings] == ["absent"] * 3


def test_the_sides_of_a_board_of_the_other_renderer_show_it(shared_data: Path) -> None:
    """It is slanted by 5 degrees: a fifth of its lines show one side alone."""
    folder = shared_data / "scans_shaken_and_raw" / "shaken_a"
    scan, by_line = read_scan(folder), np.load(folder / "truth.npz")
    n = torch.tensor(json.loads((folder / "truth.json").read_text())["n"], dtype=torch.float64)
    found = measured(scan, n)
    truth = torch.from_numpy(np.stack([by_line[name] for name in ("dx", "dz")], 1))
    sideways, deep, over_sigma = errors(found, truth).tolist()
    assert found.findings[0].edges == 2
    assert sideways < 0.02
    assert deep < 0.01
    assert 0.7 < over_sigma < 1.4
