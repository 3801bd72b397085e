"""Where the truth puts every pixel of a product: rendered sheets and rails, moving askew, with and without a log."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lsvision.geometry import ProductFrame, focal_length_px, scaled_rig, zero_disparity_mm
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    simulate,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.correction.grid import plan_product
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthSource, DepthView, Motion, Scan, StereoPair, TensorImage
from tests.stages.rendered import BOARD, FULL_RIG

# 2.1° about both axes: the motion lies 3° off the nominal.
ASKEW = MotionConfig(angle_x_deg=2.1, angle_z_deg=-2.1)
CONFIG = CorrectionConfig(height_range_mm=(-30.0, 30.0), uncertainty=True)
STEP_MM = 1.0  # between neighbouring samples: an occlusion edge


def rendered(kind: str, scale: float, stretch: float, lines: int, encoder: bool, right: bool):
    """A scan, its true depth and its true motion."""
    scene = SceneConfig(
        kind=kind,
        texture_mm=0.15 * scale,
        pitch_deg=2.0 if kind == "sheet" else 0.0,
        sheet_height_mm=0.07 * scale * lines * 0.7,
    )
    wobble = EncoderConfig(enabled=True, wobble_mm=0.05 * scale, noise_mm=0.0) if encoder else None
    source = simulate(
        scaled_rig(FULL_RIG, scale),
        BOARD,
        scene,
        dataclasses.replace(ASKEW, stretch=stretch),
        SensorConfig(supersampling=2),
        Acquisition(0.07 * scale, lines=lines, encoder=wobble),
    )
    cameras = ("left", "right") if right else ("left",)
    images = [TensorImage(torch.cat(list(source.strips(camera)))) for camera in cameras]
    depth = torch.cat(list(source.depth_strips()))
    depth_map = TensorImage(depth[..., None])
    pair = StereoPair(*images) if right else DepthView(images[0], depth_map)
    scan = Scan(Path(kind), source.rig, source.travel, pair)
    return scan, depth, Motion(source.trajectory.n, torch.zeros(3, 3, dtype=torch.float64))


def misplacement(
    scan: Scan, depth: DepthSource, true: Tensor, motion: Motion, margin: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Distance in px of every measured cell from where the truth puts what it shows, the error of its height, mm, and
    the standard deviations that the product tells of (q_x, q_y, q_z), mm.

    Cells within ``margin`` samples of an occlusion edge are left out.
    """
    grid = plan_product(scan, motion, CONFIG)
    strips = list(correct_scan(scan, depth, motion, CONFIG, grid))
    valid = torch.cat([strip.valid for strip in strips])
    line, column = torch.cat([strip.source for strip in strips])[valid].double().unbind(-1)
    height = torch.cat([strip.height for strip in strips])[valid].double()
    sigma = torch.cat([strip.sigma for strip in strips])[valid].double()
    above, before = line.floor().clamp(0, len(true) - 2).long(), column.floor().clamp(0, true.shape[1] - 2).long()
    down, right = line - above, column - before
    upper, lower = (
        torch.lerp(true[row, before].double(), true[row, before + 1].double(), right) for row in (above, above + 1)
    )
    z = torch.lerp(upper, lower, down)
    frame = ProductFrame(scan.rig, scan.travel, motion.n)
    q = frame.position(column, line, z)
    row, cell = valid.nonzero().unbind(1)
    across = (q[:, 0] - grid.origin_x_mm) / grid.pitch_mm - cell
    along = (q[:, 1] - grid.origin_y_mm) / grid.pitch_mm - row
    edges = (true.diff(dim=1, append=true[:, -1:]).abs() > STEP_MM) | (
        true.diff(dim=0, append=true[-1:]).abs() > STEP_MM
    )
    clear = F.max_pool2d(edges[None].float(), 2 * margin + 1, 1, margin)[0][above, before] == 0
    assert clear.float().mean() > 0.5
    error = height - (frame.height_datum_mm - q[:, 2])
    return torch.hypot(across, along)[clear], error[clear], sigma[clear]


@pytest.mark.parametrize("encoder", [False, True], ids=["constant", "encoder"])
@pytest.mark.parametrize("stretch", [0.9, 1.1])
@pytest.mark.parametrize("kind", ["sheet", "rail"])
def test_with_the_true_depth_nothing_is_out_of_place(kind: str, stretch: float, encoder: bool) -> None:
    scan, depth, motion = rendered(kind, 16.0, stretch, 200, encoder, right=False)
    shift, error, _ = misplacement(scan, depth_of(scan), depth, motion, 1)
    assert shift.max() < 0.002
    assert error.abs().max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "stretch", "encoder"), [("sheet", 1.07, True), ("rail", 0.93, False)])
def test_at_full_size_the_matched_depth_puts_pixels_within_a_tenth(kind: str, stretch: float, encoder: bool) -> None:
    scan, true, motion = rendered(kind, 1.0, stretch, 320, encoder, right=True)
    fine = DisparityConfig(matcher="coarse_to_fine", refine_iterations=1, largest_sigma_px=0.2, halo_lines=48)
    shift, error, sigma = misplacement(scan, depth_of(scan, fine), true, motion, 24)
    assert shift.square().mean().sqrt() <= 0.1
    # Noise of the deviations that are told would carry more cells than these beyond 0.3 px.
    told = torch.hypot(sigma[:, 0], sigma[:, 1]) / scan.travel.line_pitch_mm
    assert (shift > 0.3).sum() <= torch.erfc(0.3 / (told * math.sqrt(2))).sum()
    assert (shift > 0.3).double().mean() <= 0.002
    assert 0.7 < (error / sigma[:, 2]).square().mean().sqrt() < 1.3
    pixel_mm = zero_disparity_mm(scan.rig) ** 2 / (focal_length_px(scan.rig) * scan.rig.baseline_mm)
    assert error.abs().median() <= 0.09 * pixel_mm
