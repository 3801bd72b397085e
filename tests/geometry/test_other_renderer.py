"""The model against scans that a separate program rendered: what it predicts stands where it predicts it."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.geometry import displace, line_at, project, scan_position, transform, travel_at, triangulate
from lsvision.io import read_scan
from lsvision.types import Board, LineImage, Scan

BOARD = Board(12, 9, 30.0)
TILTS = ["tilt_a", "tilt_b", "tilt_c", "tilt_d"]


def truth(scan: Scan) -> tuple[Tensor, Tensor, Tensor]:
    data = json.loads((scan.path / "truth.json").read_text())
    n, rotation, translation = (torch.tensor(data[key], dtype=torch.float64) for key in ("n", "R", "T"))
    return n, rotation, translation


def predicted_px(scan: Scan, board_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(line, left column, right column) where the model sees points of the board."""
    n, rotation, translation = truth(scan)
    x, y, z = scan_position(transform(rotation, translation, board_points), n).unbind(-1)
    return line_at(scan.travel, y), *project(scan.rig, x, z)


def sample(image: LineImage, line: Tensor, column: Tensor) -> Tensor:
    """Brightness at the nearest pixel."""
    lines, width, _ = image.shape
    line, column = line.round().long(), column.round().long()
    assert ((line >= 0) & (line < lines) & (column >= 0) & (column < width)).all()
    return image.read(0, lines).double().mean(-1)[line, column]


@pytest.mark.parametrize("name", TILTS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_corners_stand_where_dark_and_light_squares_meet(shared_data: Path, name: str, side: str) -> None:
    scan = read_scan(shared_data / "scans_other_renderer" / name)
    image = scan.left if side == "left" else scan.images.right
    corners = BOARD.corner_points()
    quadrants = {}
    for across in (-1.0, 1.0):
        for along in (-1.0, 1.0):
            offset = torch.tensor([2.0 * across, 2.0 * along, 0.0], dtype=torch.float64)  # 3.6 px of 0.56 mm
            line, left, right = predicted_px(scan, corners + offset)
            quadrants[across, along] = sample(image, line, left if side == "left" else right)
    index = (corners[:, :2] / BOARD.square_mm).sum(-1).round().long()
    sign = torch.where(index % 2 == 0, 1.0, -1.0).double()  # the square before the origin is black
    for across, along in ((1.0, 1.0), (-1.0, -1.0)):
        assert (sign * (quadrants[across, -along] - quadrants[across, along]) > 80).all()
        assert (sign * (quadrants[-across, along] - quadrants[across, along]) > 80).all()


@pytest.mark.parametrize("name", TILTS)
def test_predicted_pixels_lead_back_to_the_board(shared_data: Path, name: str) -> None:
    scan = read_scan(shared_data / "scans_other_renderer" / name)
    n, rotation, translation = truth(scan)
    line, left, right = predicted_px(scan, BOARD.corner_points())
    x, z = triangulate(scan.rig, left, left - right)
    points = displace(torch.stack([x, travel_at(scan.travel, line), z], -1), n)
    torch.testing.assert_close((points - translation) @ rotation, BOARD.corner_points(), rtol=0, atol=1e-9)
