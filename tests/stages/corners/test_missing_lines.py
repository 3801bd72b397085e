"""Boards in scans that lack lines: the corners beside the gap are those of the whole scan, and no others are seen."""

from dataclasses import dataclass, replace

import pytest
import torch

from lsvision.errors import BoardNotFoundError
from lsvision.simulation import SceneConfig
from lsvision.stages.corners.find import find_corners
from lsvision.types import BoardCorners, DepthView, Scan, StereoPair, TensorImage
from tests.stages.rendered import BOARD, depth_scan, simulation, stereo_scan

pytestmark = pytest.mark.slow  # boards are found many times


@dataclass(frozen=True)
class Lacking(TensorImage):
    """An image without some of its lines, which read as black."""

    missing: tuple[range, ...] = ()


@pytest.fixture(scope="module")
def scan() -> Scan:
    return stereo_scan(simulation(SceneConfig(pitch_deg=6.0, roll_deg=-4.0)))


@pytest.fixture(scope="module")
def whole(scan: Scan) -> BoardCorners:
    corners = find_corners(scan, BOARD)
    assert corners.valid.all()
    return corners


def lacking(image: TensorImage, *ranges: range) -> Lacking:
    pixels = image.tensor.clone()
    for lines in ranges:
        pixels[lines.start : lines.stop] = 0
    return Lacking(pixels, ranges)


def apart(found: BoardCorners, whole: BoardCorners) -> torch.Tensor:
    """Distance of each corner that was found from the nearest of the whole board, in its own sigmas.

    Which of the board's corners it is may differ by whole squares: the pose of the board takes that up.
    """
    points, covariance = found.points[found.valid], found.covariance[found.valid]
    nearest = torch.cdist(points, whole.points).argmin(1)
    error = points - whole.points[nearest]
    return (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1).sqrt()


@pytest.mark.parametrize("height", [6, 12, 40])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.9])
def test_corners_beside_a_gap(scan, whole, height, share):
    rows = whole.left_px[:, 1]
    start = int(rows.min() + share * (rows.max() - rows.min())) - height // 2
    lost = range(start, start + height)
    pair = StereoPair(lacking(scan.left, lost), lacking(scan.images.right, lost))
    try:
        found = find_corners(replace(scan, images=pair), BOARD)
    except BoardNotFoundError:
        assert height == 40  # too little of the board is left on either side
        return
    assert found.valid.sum() >= 33
    assert apart(found, whole).max() < 2.0  # windows without the neighbours' help fit a little otherwise
    line = found.left_px[found.valid, 1]
    assert not ((line > start - 3) & (line < lost.stop + 2)).any()


def test_a_gap_beside_the_board_costs_nothing(scan, whole):
    lost = range(scan.lines - 8, scan.lines)
    pair = StereoPair(lacking(scan.left, lost), scan.images.right)
    found = find_corners(replace(scan, images=pair), BOARD)
    assert found.valid.all()
    assert apart(found, whole).max() < 1.0


def test_a_gap_in_the_image_of_a_depth_map(whole):
    measured = depth_scan(simulation(SceneConfig(pitch_deg=6.0, roll_deg=-4.0)))
    complete = find_corners(measured, BOARD)
    start = int(complete.left_px[:, 1].median())
    view = DepthView(lacking(measured.left, range(start, start + 6)), measured.images.depth)
    found = find_corners(replace(measured, images=view), BOARD)
    assert 33 <= found.valid.sum() < complete.valid.sum()
    assert apart(found, complete).max() < 2.0
