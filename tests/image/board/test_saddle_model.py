"""The picture of a corner: by hand, and its derivative against automatic differentiation of the plain formula."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from lsvision.image.board.saddle_model import FULL, PLAIN, BlurredEdges, Saddle, SaddleParameters


def plain_formula(columns: Tensor, grid: Tensor) -> Tensor:
    """Grey values (pixels) of one saddle of 17 parameters, as the docstrings write them; boxes by quadrature."""
    u0, v0, angle_1, angle_2, blur = columns[:5]
    u, v = grid
    node, weight = (torch.from_numpy(part) / 2 for part in np.polynomial.legendre.leggauss(40))
    edges = []
    for angle in (angle_1, angle_2):
        cosine, sine = torch.cos(angle), torch.sin(angle)
        distance = (u - u0) * cosine + (v - v0) * sine
        width = torch.maximum(cosine.abs(), sine.abs())
        total = (blur**2 + torch.minimum(cosine.abs(), sine.abs()) ** 2 / 12).sqrt()
        spread = distance[:, None] + width * node
        edges.append(torch.erf(spread / (math.sqrt(2.0) * total)) @ weight)
    levels = [a + b * u + c * v for a, b, c in columns[5:].reshape(4, 3)]
    return levels[0] + levels[1] * edges[0] + levels[2] * edges[1] + levels[3] * edges[0] * edges[1]


@pytest.fixture
def parameters(corners) -> SaddleParameters:
    position, angles, blur = corners
    levels = 60 * torch.randn(len(blur), 12, dtype=torch.float64)
    return SaddleParameters(torch.cat([position, angles, blur[:, None], levels], dim=-1))


@pytest.fixture
def grid() -> Tensor:
    axis = torch.arange(-3, 4, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, indexing="xy")).flatten(1)


def test_values_by_hand():
    # Sharp edges along the axes, contrast 10 on 50 with slope 2 along u. The first pixel lies a quarter of a pixel
    # right of one edge and a tenth below the other: three quarters less one quarter of it are bright, six tenths less
    # four. Right of the first edge lies another 4, more of it further down.
    parameters = torch.tensor([[0.5, -0.25, 0.0, math.pi / 2, 1e-4, 50, 2, 0, 4, 0, 1, 0, 0, 0, 10, 0, 0]]).double()
    grid = torch.tensor([[0.75, 0.5], [-0.15, -0.25]]).double()
    values = Saddle.on_grid(SaddleParameters(parameters), grid).values()
    expected = torch.tensor([51.5 + (4 - 0.15) * 0.5 + 10 * 0.5 * 0.2, 51.0]).double()
    torch.testing.assert_close(values[0], expected)


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.5, math.pi / 4, 2.0])
@pytest.mark.parametrize(("blur", "largest"), [(0.3, 5e-3), (0.6, 1e-3)])
def test_an_edge_is_the_mean_over_a_square_pixel(angle, blur, largest):
    u = torch.linspace(-2, 2, 41).double()
    centre, direction = torch.zeros(1, 2).double(), torch.tensor([[angle]]).double()
    edges = BlurredEdges.through_corners(centre, direction, torch.tensor([blur]).double(), torch.stack([u, 0.3 * u]))
    node, weight = (torch.from_numpy(part) / 2 for part in np.polynomial.legendre.leggauss(30))
    across = (u[:, None, None] + node[:, None]) * math.cos(angle) + (0.3 * u[:, None, None] + node) * math.sin(angle)
    mean = torch.erf(across / (math.sqrt(2) * blur)) @ weight @ weight
    assert (edges.value[0, 0] - mean).abs().max() < largest


def test_other_shapes_turn_with_the_picture_and_move_no_corner(parameters, grid):
    # Without gradients the model is the same after half a turn, and its derivative by the corner changes its sign.
    columns = parameters.columns.clone()
    columns[:, :2] = 0
    columns[:, 5:].unflatten(-1, (4, 3))[..., 1:] = 0
    columns[:, [8, 11]] = 0
    saddle = Saddle.on_grid(SaddleParameters(columns), grid)
    shapes, by_corner = saddle.other_shapes(), saddle.jacobian(FULL)[:, :2]
    assert (shapes @ by_corner.mT).abs().max() < 1e-6 * shapes.norm(dim=-1).max() * by_corner.norm(dim=-1).max()


def test_values_are_the_plain_formula(parameters, grid):
    values = Saddle.on_grid(parameters, grid).values()
    expected = torch.stack([plain_formula(columns, grid) for columns in parameters.columns])
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", [PLAIN, FULL], ids=["plain", "full"])
def test_jacobian_is_the_derivative_of_the_plain_formula(parameters, grid, model):
    jacobian = Saddle.on_grid(parameters, grid).jacobian(model)
    for ours, columns in zip(jacobian, parameters.columns, strict=True):
        by_autograd = torch.func.jacrev(plain_formula)(columns, grid)
        torch.testing.assert_close(ours.mT, by_autograd[:, model.free], rtol=0, atol=1e-9)


def test_parameters_at_the_centre():
    angles = torch.tensor([[0.125, 1.75]]).double()
    parameters = SaddleParameters.at_centre(angles, torch.tensor([120.0]).double(), torch.tensor([-90.0]).double())
    assert parameters.columns.tolist() == [[0, 0, 0.125, 1.75, 1, 120, 0, 0, 0, 0, 0, 0, 0, 0, -90, 0, 0]]
