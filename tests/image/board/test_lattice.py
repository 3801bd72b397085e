"""Lattices from saddles: the strongest saddles and the lattice through them."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.image.board.lattice import QuadraticMap, SeenLattice, grow_lattice, patches
from lsvision.image.board.saddle_points import SaddlePoints, find_saddle_points

INNER = (5, 4)


def bent(node: Tensor) -> Tensor:
    """Places of lattice nodes: turned, sheared, slightly curved."""
    x, y = node.double().unbind(-1)
    return torch.stack([200 + 14 * x - 6 * y + 0.1 * x * y, 150 + 5 * x + 11 * y + 0.05 * x * x], dim=-1)


@pytest.fixture
def nodes() -> Tensor:
    y, x = torch.meshgrid(torch.arange(INNER[1]), torch.arange(INNER[0]), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def saddles_at(nodes: Tensor) -> SaddlePoints:
    """Saddles on nodes, bright and dark swapped from one to the next."""
    sign = 1.0 - 2.0 * (nodes.sum(-1) % 2)
    curvature = sign[:, None] * torch.tensor([0.0, math.sqrt(0.5), 0.0])
    return SaddlePoints(bent(nodes), curvature.double(), torch.ones(len(nodes)).double())


def test_saddle_points_are_those_of_a_chequered_wave():
    v, u = torch.meshgrid(torch.arange(80.0), torch.arange(100.0), indexing="ij")
    wave = 100 + 50 * torch.sin(math.pi * u / 20) * torch.sin(math.pi * v / 20)
    saddles = find_saddle_points(wave, most=100, expected=12)
    inside = {(float(u), float(v)) for u in range(20, 100, 20) for v in range(20, 80, 20)}
    found = {tuple(point) for point in saddles.points.tolist()}
    assert inside <= found
    # The colours alternate from one to the next along either axis.
    first = saddles.points.tolist().index([20.0, 20.0])
    alignment = dict(zip(map(tuple, saddles.points.tolist()), saddles.alignment(first).tolist(), strict=True))
    assert alignment[40.0, 40.0] == pytest.approx(1.0, abs=0.01)
    assert alignment[40.0, 20.0] == pytest.approx(-1.0, abs=0.01)
    assert alignment[20.0, 40.0] == pytest.approx(-1.0, abs=0.01)


def test_fewer_points_are_the_strongest():
    brightness = torch.rand(60, 60)
    many, few = (find_saddle_points(brightness, most, expected=20) for most in (40, 10))
    assert len(few.points) == 10
    assert torch.equal(few.points, many.points[:10])


def test_quadratic_map_is_recovered():
    position = torch.randn(20, 2).double()
    truth = QuadraticMap(torch.randn(6, 2).double())
    torch.testing.assert_close(QuadraticMap.fitted(position, truth(position)).coefficients, truth.coefficients)
    x, y = position[0].tolist()
    by_hand = sum(c * p for c, p in zip(truth.coefficients[:, 0].tolist(), (1, x, y, x * x, x * y, y * y), strict=True))
    assert float(truth(position)[0, 0]) == pytest.approx(by_hand)
    matrix = torch.tensor([[1.0, 2.0], [3.0, 4.0]]).double()
    torch.testing.assert_close(QuadraticMap.linear(matrix)(position), position @ matrix.mT)


def test_a_lattice_grows_over_the_board_and_leaves_strays_out(nodes):
    board = saddles_at(nodes)
    stray = SaddlePoints(bent(torch.tensor([[3.4, 0.5], [0.4, 2.6]])), board.curvature[:2], board.evenness[:2])
    parts = ("points", "curvature", "evenness")
    saddles = SaddlePoints(*(torch.cat([getattr(board, name), getattr(stray, name)]) for name in parts))
    for seed in (0, 7, 19):
        lattice = grow_lattice(saddles, seed)
        assert lattice.on_grid.tolist() == [True] * 20 + [False] * 2
        # Which neighbours of the seed are taken decides the axes and their directions, not the distances.
        steps = (lattice.node[:20] - lattice.node[seed]).abs().sum(-1)
        assert torch.equal(steps, (nodes - nodes[seed]).abs().sum(-1).double())


def test_saddles_on_one_line_are_no_lattice(nodes):
    assert grow_lattice(saddles_at(nodes[:5]), 0) is None
    assert grow_lattice(saddles_at(nodes[:1]), 0) is None


def test_a_lattice_counted_along_other_axes(nodes):
    lattice = SeenLattice(nodes, bent(nodes))
    axes = torch.tensor([[0, -1], [1, 0]])
    turned = lattice.turned(axes, torch.tensor([3, 1]))
    assert turned.node[INNER[0] + 2].tolist() == [2, 3]  # from column 2, row 1
    same = lattice.to_image()(nodes.double())
    torch.testing.assert_close(turned.to_image()(turned.node.double()), same, rtol=0, atol=1e-8)
    torch.testing.assert_close(turned.steps(), lattice.steps() @ axes.double().mT)
    enlarged = SeenLattice(nodes, torch.tensor([[0.0, 1.0]]).double().expand(len(nodes), 2)).enlarged(4)
    assert enlarged.position[0].tolist() == [1.5, 5.5]


def test_evenness_depends_neither_on_contrast_nor_on_the_fall_off_of_light():
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    wave = torch.sin(math.pi * u / 20).sign() * torch.sin(math.pi * v / 20).sign()
    light = 1 - 0.6 * u / 160
    even = {}
    for contrast in (80.0, 8.0):
        found = find_saddle_points(100 + contrast * wave * light, most=60, expected=30)
        inside = ((found.points > 12) & (found.points < torch.tensor([148, 108]))).all(-1)
        even[contrast] = found.evenness[inside]
        assert even[contrast].max() < 1.1 * even[contrast].min()
    torch.testing.assert_close(even[80.0].mean(), even[8.0].mean(), rtol=1e-3, atol=0)


def test_patches_are_linked_by_single_steps():
    node = torch.tensor([[0, 0], [1, 0], [1, 1], [3, 1], [3, 2], [4, 3], [1, 1]])
    assert patches(node).tolist() == [0, 0, 0, 3, 3, 5, 0]
    snake = torch.tensor([[x, 0] for x in range(30)])
    assert not patches(snake.flip(0)).any()
    assert len(patches(torch.zeros(0, 2).long())) == 0


def test_saddles_of_a_background_are_apart_from_the_board(nodes):
    board = saddles_at(nodes)
    around = torch.tensor([[x, y] for x in (-4, -3, 8, 9) for y in (-3, -1, 2, 5)])
    background = saddles_at(around)
    parts = ("points", "curvature", "evenness")
    saddles = SaddlePoints(*(torch.cat([getattr(board, name), getattr(background, name)]) for name in parts))
    assert grow_lattice(saddles, 7).on_grid.tolist() == [True] * 20 + [False] * 16
