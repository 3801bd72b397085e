"""The picture of a corner: by hand, and its derivative against automatic differentiation of the plain formula."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.image.board.saddle_model import FULL, PLAIN, Saddle, SaddleParameters


def plain_formula(columns: Tensor, grid: Tensor) -> Tensor:
    """Grey values (pixels) of one saddle of 17 parameters, as the model's docstring writes them."""
    u0, v0, angle_1, angle_2, blur = columns[:5]
    u, v = grid
    edges = []
    for angle in (angle_1, angle_2):
        distance = (u - u0) * torch.cos(angle) + (v - v0) * torch.sin(angle)
        edges.append(torch.erf(distance / (math.sqrt(2.0) * blur)))
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
    # Edges along the axes, blur 1, contrast 10 on 50 with slope 2 along u: at one blur right of and below the corner
    # both edges are erf(1 / sqrt 2), the share of a normal distribution within one sigma. Right of the first edge lies
    # another 4, more of it further down.
    parameters = torch.tensor([[0.5, -0.25, 0.0, math.pi / 2, 1.0, 50, 2, 0, 4, 0, 1, 0, 0, 0, 10, 0, 0]]).double()
    grid = torch.tensor([[1.5, 0.5], [0.75, -0.25]]).double()
    values = Saddle.on_grid(SaddleParameters(parameters), grid).values()
    share = 0.6826894921370859
    expected = torch.tensor([53.0 + (4 + 0.75) * share + 10 * share**2, 51.0]).double()
    torch.testing.assert_close(values[0], expected)


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
