"""Trilinear sensors: in the product, every colour lies where a sensor that sees all colours at once would show it."""

import dataclasses
import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    simulate,
)
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.correction.correct import correct_scan
from lsvision.stages.disparity.depth import depth_of
from lsvision.types import DepthView, Motion, Rig, Scan, TensorImage, Transport
from tests.combinations import crossed
from tests.stages.rendered import BOARD, PITCH, SMALL_RIG

MOTION = MotionConfig(angle_x_deg=-2.0, angle_z_deg=2.0, stretch=1.07)
CONFIG = CorrectionConfig(height_range_mm=(-30.0, 30.0), strip_rows=1000)
WOBBLE = EncoderConfig(enabled=True, wobble_mm=3.0, noise_mm=0.0)
PATCH = (slice(90, 250), slice(170, 300))
APART = 1.5


def product(
    spacing: float,
    *,
    registered: bool,
    transport: Transport,
    encoder: EncoderConfig | None,
    corrected: bool = True,
    offset_mm: float = 0.0,
):
    """Colours of a sheet seen by a sensor whose red and blue lines look ``spacing`` lines before and after green."""
    rig = dataclasses.replace(SMALL_RIG, color_spacing_lines=(-spacing, 0.0, spacing))
    source = seen(rig, transport, encoder, offset_mm, registered=registered)
    images = DepthView(TensorImage(torch.cat(list(source.strips("left")))), depth_map(transport, encoder, offset_mm))
    scan = Scan(Path("sheet"), rig if corrected else SMALL_RIG, source.travel, images, color_registered=registered)
    motion = Motion(source.trajectory.n, torch.zeros(3, 3).double())
    (strip,) = correct_scan(scan, depth_of(scan), motion, CONFIG)
    assert bool(strip.valid[PATCH].all())
    return strip.color[PATCH].to(torch.float32)


def seen(
    rig: Rig, transport: Transport, encoder: EncoderConfig | None, offset_mm: float, *, registered: bool = False
) -> Simulation:
    sensor = SensorConfig(supersampling=2, noise=0.0, color_registered=registered)
    sheet = SceneConfig(kind="sheet", yaw_deg=3.0, depth_offset_mm=offset_mm)
    return simulate(rig, BOARD, sheet, MOTION, sensor, Acquisition(PITCH, transport=transport, encoder=encoder))


@functools.cache
def depth_map(transport: Transport, encoder: EncoderConfig | None, offset_mm: float) -> TensorImage:
    """The same whatever lines the colours lie on."""
    return TensorImage(torch.cat(list(seen(SMALL_RIG, transport, encoder, offset_mm).depth_strips()))[..., None])


@functools.cache
def truth_of(transport: Transport, encoder: EncoderConfig | None, offset_mm: float = 0.0) -> Tensor:
    """Colours that a sensor sees all at once: registered or not is the same."""
    return product(0.0, registered=False, transport=transport, encoder=encoder, offset_mm=offset_mm)


def shift_along(image: Tensor, truth: Tensor) -> float:
    """Rows by which an image lies further than another of the same: least squares on the gradient."""
    smooth = cv2.GaussianBlur(truth.numpy(), (0, 0), 1.5)
    other = cv2.GaussianBlur(image.numpy(), (0, 0), 1.5)
    moved, total = other, 0.0
    for _ in range(8):
        slope = np.gradient(moved, axis=0)[8:-8, 8:-8]
        step = float(((smooth - moved)[8:-8, 8:-8] * slope).sum() / (slope * slope).sum())
        total += step
        transform = np.array([[1, 0, 0], [0, 1, total]], np.float32)
        moved = cv2.warpAffine(other, transform, other.shape[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    return -total


@crossed("registered transport encoder", [False, True], ["forward", "reverse"], [None, WOBBLE])
def test_red_and_blue_meet(registered: bool, transport: Transport, encoder: EncoderConfig | None) -> None:
    options = {"registered": registered, "transport": transport, "encoder": encoder}
    truth = truth_of(transport, encoder)
    trilinear = product(APART / 2, **options)
    red, green, blue = (shift_along(trilinear[..., c], truth[..., c]) for c in range(3))
    assert abs(red - blue) <= 0.05
    assert max(abs(red), abs(green), abs(blue)) <= 0.05


@pytest.mark.parametrize("offset_mm", [-20.0, 20.0])
def test_red_and_blue_meet_at_other_depths(offset_mm: float) -> None:
    """The lines look 2.5 % less apart 20 mm nearer: 0.2 of 8 rows."""
    options = {"registered": True, "transport": "forward", "encoder": None, "offset_mm": offset_mm}
    truth, trilinear = truth_of("forward", None, offset_mm), product(8.0, **options)
    red, blue = (shift_along(trilinear[..., c], truth[..., c]) for c in (0, 2))
    assert max(abs(red), abs(blue)) <= 0.05


def test_uncorrected_they_lie_as_far_apart_as_the_sensor_lines() -> None:
    options = {"registered": False, "transport": "forward", "encoder": None}
    truth = truth_of("forward", None)
    fringed = product(APART / 2, **options, corrected=False)
    assert abs(shift_along(fringed[..., 0], truth[..., 0]) - shift_along(fringed[..., 2], truth[..., 2])) == (
        pytest.approx(APART, abs=0.1)
    )
