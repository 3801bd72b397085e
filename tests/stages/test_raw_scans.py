"""Raw scans from start to end at a quarter of the pixels: depth, its shape across the line, and the corrected board."""

from pathlib import Path

import pytest
import torch

from lsvision.geometry import scaled_raw_rig
from lsvision.simulation import Acquisition, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.measurement import measure_board
from lsvision.types import Motion, Scan, StereoPair, TensorImage
from tests.raw_cameras import RAW
from tests.stages.disparity.test_rectify import error_px
from tests.stages.rendered import BOARD, MOTION

SCALE = 4
UM_PER_PX = 157.6 * SCALE


def rendered(scene: SceneConfig) -> tuple[Simulation, Scan]:
    source = simulate(
        scaled_raw_rig(RAW, SCALE), BOARD, scene, MOTION, SensorConfig(), Acquisition(0.07 * SCALE)
    )  # fmt: skip
    images = StereoPair(*(TensorImage(torch.cat(list(source.strips(camera)))) for camera in ("left", "right")))
    return source, Scan(Path("raw"), source.rig, source.travel, images, raw_rig=source.raw_rig)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_flat_sheet_is_flat(seed):
    scene = SceneConfig("sheet", pitch_deg=2.0, roll_deg=1.5, margin_mm=0.0, sheet_height_mm=150.0, seed=seed)
    source, scan = rendered(scene)
    depth = depth_of(scan, n=source.trajectory.n).read(0, scan.lines)
    error, _ = error_px(scan, depth.z, source.pose, source.trajectory.n, (360.0, 150.0))
    assert error[error.isfinite()].square().mean().sqrt() < 0.06
    # What all lines have in common, by eighths of the sheet's width and in the mean of its columns.
    curve = error.nanmean(0)
    curve = curve[error.isfinite().sum(0) > 100]
    parts = torch.stack([part.mean() for part in curve.tensor_split(8)])
    assert ((parts - parts.mean()).abs() * UM_PER_PX).max() < 5


@pytest.mark.slow
def test_corrected_board():
    source, scan = rendered(SceneConfig(pitch_deg=2.0, roll_deg=1.5, yaw_deg=92.0))
    motion, config = Motion(source.trajectory.n, torch.zeros(3, 3).double()), CorrectionConfig()
    grid = plan_product(scan, motion, config)
    strips = list(correct_scan(scan, depth_of(scan, n=motion.n), motion, config, grid))
    color, height = (torch.cat([getattr(strip, name) for strip in strips]) for name in ("color", "height"))
    board = measure_board(TensorImage(color), TensorImage(height[..., None]), grid, BOARD)
    assert board is not None
    assert int(board.valid.sum()) >= 85
    assert board.distance_rms_mm < 0.06
