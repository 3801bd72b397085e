"""Boards in long images: found wherever they lie, read part by part, and not seen where there is none."""

import math

import pytest
import torch

from lsvision.image.board.search import search_board
from lsvision.types import Board, TensorImage

BOARD = Board(6, 5, 30.0)
PITCH, WIDTH = 2.5, 120


class Drawn:
    """Texture with a board turned by 20° whose middle lies at a place along the image; notes what is read at once."""

    dtype = torch.uint8

    def __init__(self, lines: int, place_mm: float | None) -> None:
        self.shape = (lines, WIDTH, 1)
        self.place_mm, self.most, self.texture = place_mm, 0, torch.rand(64, WIDTH)

    def read(self, start: int, stop: int) -> torch.Tensor:
        self.most = max(self.most, stop - start)
        line = torch.arange(start, stop)
        image = 100 + 30 * self.texture[line % 64].double()
        if self.place_mm is not None:
            x, y = torch.meshgrid(torch.arange(WIDTH) - WIDTH / 2, line - self.place_mm / PITCH, indexing="xy")
            cosine, sine = math.cos(0.35), math.sin(0.35)
            square = PITCH * torch.stack([x * cosine + y * sine, y * cosine - x * sine]) / 30 + torch.tensor(
                [[[3.0]], [[2.5]]]
            )
            size = torch.tensor([[[6.0]], [[5.0]]])
            paper = ((square >= -0.5) & (square <= size + 0.5)).all(0)
            black = (square.floor().sum(0) % 2 == 0) & ((square >= 0) & (square < size)).all(0)
            image = torch.where(paper, torch.where(black, 40.0, 210.0), image)
        return image.to(torch.uint8)[..., None]


@pytest.mark.parametrize("place_mm", [120.0, 1130.0, 2017.5, 2850.0])
def test_a_board_anywhere_in_a_long_image(place_mm):
    image = Drawn(1200, place_mm)
    found = search_board(image, BOARD, PITCH)
    assert found is not None
    assert found.valid.all()
    middle = found.position.mean(0)
    assert (middle - torch.tensor([WIDTH / 2, place_mm / PITCH])).norm() < 0.2
    assert image.most < 500  # of 1200, however long


def test_no_board():
    assert search_board(Drawn(1200, None), BOARD, PITCH) is None
    assert search_board(TensorImage(torch.zeros(1000, WIDTH, 3, dtype=torch.uint8)), BOARD, PITCH) is None


@pytest.mark.parametrize(("width", "pitch"), [(4, 2.5), (64, 7.8), (64, 0.07), (1, 2.5)])
def test_an_image_that_cannot_show_a_board(width, pitch):
    """Too narrow, or squares of a few pixels: nothing of a long one is searched."""
    assert search_board(TensorImage(torch.zeros(40_000, width, 1, dtype=torch.uint8)), BOARD, pitch) is None
