"""Boards on lattices that are partly seen: the place, the side, and the corners that are missing."""

import pytest
import torch
from torch import Tensor

from lsvision.image.board.lattice import SeenLattice
from lsvision.image.board.placement import LatticeView, place_board

INNER = (11, 8)
STEP = 20.0


def board_nodes() -> Tensor:
    y, x = torch.meshgrid(torch.arange(INNER[1]), torch.arange(INNER[0]), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def view(node: Tensor, position: Tensor, width: float = 400.0) -> LatticeView:
    """What an image of 300 lines shows of corners at given positions."""
    seen = (position[:, 0] > 9) & (position[:, 0] < width - 10)
    return LatticeView(SeenLattice(node[seen], position[seen]), (300, int(width)), 8)


@pytest.mark.parametrize("turned", [False, True])
def test_missing_corners_lie_where_the_lattice_continues(turned):
    nodes = board_nodes()
    position = 40 + nodes.double() * STEP
    kept = torch.ones(88, dtype=torch.bool)
    kept[[0, 7, 13, 87]] = False
    node = nodes.flip(-1) if turned else nodes
    [grid] = place_board([view(node[kept] - 3, position[kept])], INNER)
    torch.testing.assert_close(grid.reshape(-1, 2), position, rtol=0, atol=1e-9)


@pytest.mark.parametrize("columns", [1, 3, 5])
@pytest.mark.parametrize("side", ["left", "right"])
def test_the_rim_that_is_seen_says_where_a_cut_board_lies(side, columns):
    nodes = board_nodes()
    shift = 12 - columns * STEP if side == "left" else 400 - 12 - (10 - columns) * STEP
    position = torch.tensor([shift, 60.0]) + nodes.double() * STEP
    [grid] = place_board([view(nodes - 7, position)], INNER)
    torch.testing.assert_close(grid.reshape(-1, 2), position, rtol=0, atol=1e-9)


def test_each_image_may_show_another_part():
    nodes = board_nodes()
    left = torch.tensor([12 - 3 * STEP, 60.0]) + nodes.double() * STEP
    right = torch.tensor([400 - 12 - 8 * STEP, 60.0]) + nodes.double() * STEP
    grids = place_board([view(nodes + 4, left), view(nodes + 4, right)], INNER)
    for grid, position in zip(grids, (left, right), strict=True):
        torch.testing.assert_close(grid.reshape(-1, 2), position, rtol=0, atol=1e-9)


def test_a_board_beyond_both_rims_lies_anywhere():
    nodes = board_nodes()
    position = torch.tensor([-28.0, 60.0]) + nodes.double() * STEP
    seen = view(nodes, position, width=180.0)
    [grid] = place_board([seen], INNER)
    distance = torch.cdist(seen.lattice.position, grid.reshape(-1, 2))
    assert distance.amin(1).max() < 1e-6


def test_too_few_corners_or_too_many_strays_are_no_board():
    nodes = board_nodes()
    position = 40 + nodes.double() * STEP
    assert place_board([view(nodes[:30], position[:30])], INNER) is None
    strays = torch.cat([nodes, torch.tensor([[x, 14] for x in range(12)])])
    assert place_board([view(strays, 10.0 + strays.double())], INNER) is None
