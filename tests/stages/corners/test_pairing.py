"""Boards that either image shows a part of: which corner is which in both."""

import dataclasses
from functools import cache

import cv2
import pytest
import torch
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, simulate
from lsvision.stages.corners.find import find_corners
from lsvision.types import Board, BoardCorners, Scan, StereoPair, TensorImage
from tests.stages.rendered import BOARD, FINE_SENSOR, PITCH, SMALL_RIG, simulation, stereo_scan, true_measurement

pytestmark = pytest.mark.slow  # boards are found many times

SQUARE_PX = 27


@dataclasses.dataclass(frozen=True)
class Rendered:
    """A scan, and the true points and pixels of its corners."""

    scan: Scan
    points: Tensor
    left_px: Tensor
    right_px: Tensor


@cache
def rendered(yaw_deg: float, pitch_deg: float = 5.0) -> Rendered:
    source = simulation(SceneConfig(pitch_deg=pitch_deg, roll_deg=-4.0, yaw_deg=yaw_deg))
    return Rendered(stereo_scan(source), true_measurement(source), *source.corners())


def cut(whole: Rendered, sides: tuple[str, str], squares: float) -> Scan:
    """The scan with some squares of the board beyond one rim of either image; both keep the width of a sensor."""
    images, first = [], []
    for image, px, side in zip(images_of(whole.scan), (whole.left_px, whole.right_px), sides, strict=True):
        column = px[:, 0]
        left = int(column.min() + squares * SQUARE_PX) if side == "left" else 0
        right = int(column.max() - squares * SQUARE_PX) if side == "right" else image.shape[1]
        blank = torch.full_like(image, 30)
        blank[:, : right - left] = image[:, left:right]
        images.append(TensorImage(blank))
        first.append(left)
    rig = dataclasses.replace(
        whole.scan.rig,
        principal_left_px=SMALL_RIG.principal_left_px - first[0],
        principal_right_px=SMALL_RIG.principal_right_px - first[1],
    )
    return dataclasses.replace(whole.scan, rig=rig, images=StereoPair(*images))


def images_of(scan: Scan) -> tuple[Tensor, Tensor]:
    return scan.left.tensor, scan.images.right.tensor


def with_images(scan: Scan, change) -> Scan:
    return dataclasses.replace(scan, images=StereoPair(*(TensorImage(change(image)) for image in images_of(scan))))


def assert_right(corners: BoardCorners, whole: Rendered, fewest: int) -> None:
    assert int(corners.valid.sum()) >= fewest
    error = (corners.points - whole.points)[corners.valid]
    assert (error.abs() < torch.tensor([0.2, 0.2, 0.5])).all()


@pytest.mark.parametrize(
    ("yaw", "sides"),
    [
        (2.0, ("left", "left")),
        (2.0, ("left", "right")),
        (93.0, ("right", "right")),
        (93.0, ("left", "right")),
        (216.0, ("left", "right")),
    ],
)
def test_columns_beyond_the_rims(yaw, sides):
    whole = rendered(yaw)
    assert_right(find_corners(cut(whole, sides, 1.5), BOARD), whole, 40)


@pytest.mark.parametrize("yaw", [2.0, 93.0])
def test_lines_before_the_first_and_after_the_last(yaw):
    whole = rendered(yaw)
    first = int(whole.left_px[:, 1].min() + 2.4 * SQUARE_PX)
    last = int(whole.left_px[:, 1].max() - 2.4 * SQUARE_PX)
    assert_right(find_corners(with_images(whole.scan, lambda image: image[:last]), BOARD), whole, 50)
    late = find_corners(with_images(whole.scan, lambda image: image[first:]), BOARD)
    moved = dataclasses.replace(whole, points=whole.points - late.points.new_tensor([0.0, first * PITCH, 0.0]))
    assert_right(late, moved, 50)


def test_a_board_that_looks_the_same_upside_down_is_paired_by_its_lines():
    # Its X runs along the motion: which way is towards larger columns differs between the cameras.
    board = Board(12, 8, 30.0)
    scene = SceneConfig(pitch_deg=0.0, roll_deg=-6.0, yaw_deg=90.0)
    source = simulate(SMALL_RIG, board, scene, MotionConfig(), FINE_SENSOR, Acquisition(PITCH))
    corners = find_corners(stereo_scan(source), board)
    assert corners.valid.all()
    assert (corners.left_px - corners.right_px)[:, 1].abs().max() < 0.1


def test_parts_whose_squares_have_another_size_are_refused():
    scan = cut(rendered(2.0), ("left", "right"), 1.5)
    with pytest.raises(BoardNotFoundError, match=r"rendered: .* which corners they share is not clear: .* not 27 mm"):
        find_corners(scan, Board(12, 9, 27.0))
    # A whole board leaves no choice: its size is for the calibration to judge.
    assert find_corners(rendered(2.0).scan, Board(12, 9, 27.0)).valid.all()


def test_boards_of_other_lines_are_refused():
    scan = rendered(2.0).scan
    left, right = images_of(scan)
    moved = torch.roll(right, 12, 0)
    with pytest.raises(BoardNotFoundError, match=r"rendered: no board in both images: they share no part"):
        find_corners(dataclasses.replace(scan, images=StereoPair(TensorImage(left), TensorImage(moved))), BOARD)


@pytest.mark.parametrize("yaw", [2.0, 216.0])
@pytest.mark.parametrize(("contrast", "fall_off"), [(0.2, 0.0), (0.2, 0.45), (1.0, 0.45)])
def test_saddles_find_faint_and_unevenly_lit_boards(monkeypatch, contrast, fall_off, yaw):
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: (False, None))
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_, **__: (False, None))

    def change(image: Tensor) -> Tensor:
        light = 1 - fall_off * torch.linspace(0, 1, image.shape[1])[:, None]
        faint = 110 + contrast * (image * light - 110) + torch.randn(image.shape)
        return faint.round().to(torch.uint8)

    whole = rendered(yaw)
    corners = find_corners(with_images(whole.scan, change), BOARD)
    assert int(corners.valid.sum()) >= 80
    assert (corners.left_px - whole.left_px)[corners.valid].abs().max() < 0.3
    assert (corners.right_px - whole.right_px)[corners.valid].abs().max() < 0.3
