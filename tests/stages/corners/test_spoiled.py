"""Boards of which a part is hidden, under glare or in shadow: what counts as measured is right, its sigma included."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.simulation import SceneConfig
from lsvision.stages.corners.find import find_corners
from lsvision.types import Scan, StereoPair, TensorImage
from tests.stages.rendered import BOARD, simulation, stereo_scan, true_measurement

SQUARE_PX = 27


def offsets(image: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of each pixel from a corner, in squares, along columns and lines."""
    v, u = torch.meshgrid(torch.arange(image.shape[0]), torch.arange(image.shape[1]), indexing="ij")
    return (u - corner[0]) / SQUARE_PX, (v - corner[1]) / SQUARE_PX


def clamp(image: Tensor, corner: Tensor) -> Tensor:
    u, v = offsets(image, corner)
    return torch.where(((u - 1).abs() < 1.6) & ((v + 0.3).abs() < 0.9), 80.0, image)


def finger(image: Tensor, corner: Tensor) -> Tensor:
    u, v = offsets(image, corner)
    return torch.where((u / 1.1).square() + (v / 2.2).square() < 1, 130.0, image)


def glare(image: Tensor, corner: Tensor) -> Tensor:
    u, v = offsets(image, corner)
    return image + 400 * torch.exp(-(u.square() + v.square()) / 3)


def shadow(image: Tensor, corner: Tensor) -> Tensor:
    u, _ = offsets(image, corner)
    return torch.where(u > 0.1, 0.35 * image, image)


@pytest.mark.parametrize(
    "in_both", [pytest.param(True, marks=pytest.mark.slow, id="both"), pytest.param(False, id="one")]
)
@pytest.mark.parametrize("spoil", [pytest.param(clamp, marks=pytest.mark.slow), finger, glare, shadow])
def test_what_is_left_is_right(spoil, in_both):
    source = simulation(SceneConfig(pitch_deg=5.0, roll_deg=-4.0, yaw_deg=14.0))
    scan = stereo_scan(source)
    images = []
    for image, px in zip((scan.left, scan.images.right), source.corners(), strict=True):
        grey = image.tensor.float().mean(-1)
        if in_both or not images:
            grey = spoil(grey, px[35])
        images.append(TensorImage(grey.round().clamp(0, 255).to(torch.uint8)[..., None]))
    corners = find_corners(Scan(scan.path, scan.rig, scan.travel, StereoPair(*images)), BOARD)
    valid = corners.valid
    assert 50 <= int(valid.sum()) < 88
    error = (corners.points - true_measurement(source))[valid]
    assert (error.abs() < torch.tensor([0.15, 0.15, 0.3])).all()
    squared = (error * torch.linalg.solve(corners.covariance[valid], error[..., None])[..., 0]).sum(-1)
    assert squared.mean() < 4.5
    assert math.isfinite(float(squared.max()))
