"""Boards in images: the order of the corners, their position, and reading by line ranges."""

import dataclasses
import functools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from lsvision.geometry import line_at, project, scan_position, transform
from lsvision.image.board.detect import detect_board, reduce_image
from lsvision.image.board.order import order_grid
from lsvision.image.board.refine import refine_grid
from lsvision.image.brightness import gray
from lsvision.io import read_scan
from lsvision.types import Board, TensorImage
from tests.combinations import crossed

ASYMMETRIC = Board(6, 5, 20.0)  # like the GP400: X from two black corner squares to two white ones
SIDE = 16  # pixels of a square
MARGIN = 24


@functools.cache
def drawn_board(board: Board) -> tuple[Tensor, Tensor]:
    """A grey board, uint8 ``(lines, width, 1)``, with its X along the columns, and its corners (u, v) in board order.

    The short side of two black corner squares is on the left.
    """
    width, lines = board.columns * SIDE + 2 * MARGIN, board.rows * SIDE + 2 * MARGIN
    fine = 4
    v, u = torch.meshgrid(torch.arange(lines * fine), torch.arange(width * fine), indexing="ij")
    column, row = (torch.div(t / fine - MARGIN, SIDE, rounding_mode="floor") for t in (u, v))
    inside = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
    black = inside & ((column + row) % 2 == 0)
    image = torch.where(black, 30.0, 220.0)
    kernel = torch.exp(-0.5 * (torch.arange(-4 * fine, 4 * fine + 1) / fine) ** 2)
    kernel = kernel / kernel.sum()
    for shape in ((1, 1, 1, -1), (1, 1, -1, 1)):
        k = kernel.reshape(shape)
        pad = (4 * fine, 4 * fine, 0, 0) if shape[-1] == -1 else (0, 0, 4 * fine, 4 * fine)
        image = torch.nn.functional.conv2d(
            torch.nn.functional.pad(image.reshape(1, 1, *image.shape[-2:]), pad, mode="replicate"), k
        )[0, 0]
    image = torch.nn.functional.avg_pool2d(image[None], fine)[0]
    nx, ny = board.inner
    row, column = torch.meshgrid(torch.arange(1, ny + 1), torch.arange(1, nx + 1), indexing="ij")
    corners = torch.stack([column, row], -1).double() * SIDE + MARGIN - 0.5
    return image.round().to(torch.uint8)[..., None], corners


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("flips", [(), (0,), (1,), (0, 1)])
def test_order_does_not_depend_on_the_order_found(flips, turned):
    image, corners = drawn_board(ASYMMETRIC)
    brightness = gray(image)
    if turned:  # the board upside down: its corners, in board order, run the other way in the image
        brightness = brightness.flip(0, 1)
        corners = torch.tensor([brightness.shape[1], brightness.shape[0]]).double() - 1 - corners
    assert torch.equal(order_grid(corners.flip(flips), brightness), corners)


@pytest.mark.parametrize("flips", [(), (0,), (1,), (0, 1)])
@pytest.mark.parametrize("axis", [0, 1])
def test_order_in_a_mirrored_image(axis, flips):
    image, corners = drawn_board(ASYMMETRIC)
    brightness = gray(image).flip(axis)
    mirrored = corners.clone()
    mirrored[..., 1 - axis] = brightness.shape[axis] - 1 - mirrored[..., 1 - axis]
    assert torch.equal(order_grid(mirrored.flip(flips), brightness, mirrored=True), mirrored)


def test_a_symmetric_board_keeps_x_towards_larger_columns():
    image, corners = drawn_board(Board(7, 5, 20.0))
    assert torch.equal(order_grid(corners.flip(0, 1), gray(image)), corners)


def test_drawn_corners_are_found():
    image, corners = drawn_board(ASYMMETRIC)
    detected = detect_board(TensorImage(image), ASYMMETRIC)
    assert detected is not None
    assert detected.valid.all()
    assert (detected.position - corners.reshape(-1, 2)).abs().max() < 0.01


def test_colours_and_sixteen_bits_find_the_same_corners():
    image, _ = drawn_board(ASYMMETRIC)
    grey = detect_board(TensorImage(image), ASYMMETRIC)
    for other in (image.expand(-1, -1, 3), image.to(torch.int32).mul(257).to(torch.uint16)):
        found = detect_board(TensorImage(other), ASYMMETRIC)
        torch.testing.assert_close(found.position, grey.position, rtol=0, atol=1e-4)


@pytest.mark.parametrize("factor", [1, 3, 8])
def test_reduction_is_the_plain_average(factor):
    image = torch.randint(0, 256, (1100, 50, 3)).to(torch.uint8)
    reduced = reduce_image(TensorImage(image), factor)
    rows, columns = 1100 // factor, 50 // factor
    assert reduced.shape == (rows, columns)
    luma = image.double() @ torch.tensor([0.299, 0.587, 0.114]).double()
    blocks = luma[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    assert (reduced - blocks.mean((1, 3))).abs().max() <= 1.0  # the luma and its average are rounded
    deep = reduce_image(TensorImage(image.to(torch.uint16)), factor)
    torch.testing.assert_close(deep.double(), blocks.mean((1, 3)), rtol=0, atol=1e-3)
    assert reduce_image(TensorImage(image[: factor - 1]), factor).shape == (0, columns)


def test_no_board_is_none():
    noise = torch.randint(0, 256, (300, 400, 1)).to(torch.uint8)
    flat = torch.full((300, 400, 1), 90, dtype=torch.uint8)
    stripes = ((torch.arange(400) // 20 % 2) * 200).to(torch.uint8).expand(300, 400)[..., None].contiguous()
    for image in (noise, flat, stripes, flat[:5]):
        assert detect_board(TensorImage(image), ASYMMETRIC) is None
    image, _ = drawn_board(ASYMMETRIC)
    assert detect_board(TensorImage(image), Board(9, 8, 20.0)) is None


def test_windows_beyond_the_image_are_invalid():
    image, corners = drawn_board(ASYMMETRIC)
    # Cut so close that a column of corners stands at the rim.
    left = int(corners[0, 0, 0]) - 1
    detected = refine_grid(TensorImage(image[:, left:]), corners - torch.tensor([float(left), 0.0]).double())
    valid = detected.valid.reshape(corners.shape[:2])
    assert not valid[:, 0].any()
    assert valid[:, 1:].all()
    assert detected.position[~detected.valid].isnan().all()
    assert detected.covariance[~detected.valid].isnan().all()
    expected = (corners - torch.tensor([float(left), 0.0])).reshape(-1, 2)[detected.valid]
    torch.testing.assert_close(detected.position[detected.valid], expected, rtol=0, atol=0.01)


def test_smear_glare_and_dirt_cost_only_their_corners():
    image, corners = drawn_board(ASYMMETRIC)
    spoiled = image.clone()
    for (row, column), box in (((1, 1), "glare"), ((2, 3), "smear"), ((3, 0), "dirt")):
        u, v = (int(x) for x in corners[row, column].round())
        patch = spoiled[v - 4 : v + 5, u - 4 : u + 5]
        patch[:] = {"glare": 255, "smear": int(patch.float().mean()), "dirt": 20}[box]
        if box == "smear":
            patch[:] = image[v - 4, u - 4 : u + 5]
    noisy = (spoiled + 2 * torch.randn(spoiled.shape)).clamp(0, 255).to(torch.uint8)
    detected = refine_grid(TensorImage(noisy), corners)
    spoilt = torch.zeros(corners.shape[:2], dtype=torch.bool)
    spoilt[1, 1] = spoilt[2, 3] = spoilt[3, 0] = True
    assert torch.equal(detected.valid, ~spoilt.reshape(-1))
    error = (detected.position - corners.reshape(-1, 2))[detected.valid]
    assert error.abs().max() < 0.05


@crossed("stretch yaw", [0.5, 1.0, 2.0], [0.0, 37.0, 105.0, 200.0, 345.0])
def test_any_angle_shear_and_stretch(stretch, yaw):
    board = Board(12, 9, 30.0)
    image, corners = drawn_board(board)
    turn = math.radians(yaw)
    matrix = np.array([[1.0, 0.15], [0.0, stretch]]) @ np.array(
        [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    )
    matrix = 1.5 * matrix
    rim = np.array([[0, 0], [image.shape[1], 0], [0, image.shape[0]], [image.shape[1], image.shape[0]]]) @ matrix.T
    shift = 10 - rim.min(0)
    size = tuple(int(n) for n in np.ceil(np.ptp(rim, axis=0)) + 20)
    warped = cv2.warpAffine(
        image[..., 0].numpy(), np.c_[matrix, shift], size, flags=cv2.INTER_CUBIC, borderValue=(220,)
    )
    noisy = torch.from_numpy(warped)[..., None] + 2 * torch.randn(*warped.shape, 1)
    detected = detect_board(TensorImage(noisy.clamp(0, 255).to(torch.uint8)), board)
    truth = corners.reshape(-1, 2) @ torch.from_numpy(matrix).mT + torch.from_numpy(shift)
    assert detected is not None
    assert detected.valid.float().mean() > 0.95
    assert (detected.position - truth)[detected.valid].square().mean().sqrt() < 0.1


def test_a_board_partly_beyond_the_image():
    board = Board(12, 9, 30.0)
    image, corners = drawn_board(board)
    left = int(corners[0, 3, 0]) - 6  # three columns of corners are cut off, a fourth stands at the rim
    detected = detect_board(TensorImage(image[:, left:].contiguous()), board)
    assert detected is not None
    found = detected.position.reshape(8, 11, 2)[detected.valid.reshape(8, 11)]
    assert len(found) >= 56
    # It may count from another square; each corner found is one of the board's.
    distance = torch.cdist(found, corners.reshape(-1, 2) - torch.tensor([float(left), 0.0]).double())
    assert distance.amin(1).max() < 0.02
    assert len(distance.argmin(1).unique()) == len(found)


def test_a_poor_start_is_refined_and_a_wrong_one_refused():
    image, corners = drawn_board(ASYMMETRIC)
    moved = corners + 3 * torch.rand_like(corners) - 1.5
    detected = refine_grid(TensorImage(image), moved)
    assert detected.valid.all()
    assert (detected.position - corners.reshape(-1, 2)).abs().max() < 0.01
    noisy = (image + 3 * torch.randn(image.shape)).clamp(0, 255).to(torch.uint8)
    assert not refine_grid(TensorImage(noisy), corners + SIDE / 2).valid.any()


@dataclasses.dataclass(frozen=True)
class CountedImage(TensorImage):
    """Remembers how many lines each read asked for."""

    reads: list[int] = dataclasses.field(default_factory=list)

    def read(self, start: int, stop: int) -> Tensor:
        self.reads.append(stop - start)
        return super().read(start, stop)


def test_a_long_image_is_read_in_parts():
    image, corners = drawn_board(ASYMMETRIC)
    tall = torch.full((4000, image.shape[1], 1), 220, dtype=torch.uint8)
    tall[2000 : 2000 + len(image)] = image  # corners on both sides of a multiple of the strips
    counted = CountedImage(tall)
    detected = detect_board(counted, ASYMMETRIC)
    expected = corners.reshape(-1, 2) + torch.tensor([0.0, 2000.0])
    torch.testing.assert_close(detected.position, expected, rtol=0, atol=0.01)
    assert max(counted.reads) < 600
    assert sum(counted.reads) < 4000 + 3 * 600


@pytest.mark.parametrize("name", ["tilt_a", *(pytest.param(f"tilt_{name}", marks=pytest.mark.slow) for name in "bcd")])
def test_boards_of_another_renderer(shared_data: Path, name: str):
    scan = read_scan(shared_data / "scans_other_renderer" / name)
    board = Board(12, 9, 30.0)
    for image, truth in zip((scan.left, scan.images.right), true_corners(scan, board), strict=True):
        detected = detect_board(image, board)
        assert detected is not None
        assert detected.valid.all()
        assert (detected.position - truth).square().mean().sqrt() <= 0.015


def true_corners(scan, board: Board) -> tuple[Tensor, Tensor]:
    """(u, v) of the corners in the left and right image by the renderer's own pose and motion."""
    data = json.loads((scan.path / "truth.json").read_text())
    n, rotation, translation = (torch.tensor(data[key], dtype=torch.float64) for key in ("n", "R", "T"))
    x, y, z = scan_position(transform(rotation, translation, board.corner_points()), n).unbind(-1)
    line = line_at(scan.travel, y)
    left, right = project(scan.rig, x, z)
    return torch.stack([left, line], -1), torch.stack([right, line], -1)


@pytest.mark.parametrize("size", [(2, 2), (2, 9), (3, 9), (9, 3)])
def test_boards_too_narrow_for_opencv_are_looked_for_as_well(size):
    assert detect_board(TensorImage(torch.randint(0, 255, (300, 300, 1)).to(torch.uint8)), Board(*size, 30.0)) is None
