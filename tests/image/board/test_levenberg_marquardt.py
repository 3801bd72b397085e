"""The fit of saddles: the normal equations and the minimum, against plain formulas one window at a time."""

import pytest
import torch

from lsvision.image.board.levenberg_marquardt import Linearisation, NormalMatrix, Windows, fit_parameters, pixel_grid
from lsvision.image.board.saddle_model import FULL, PLAIN, Saddle, SaddleParameters
from tests.image.board.conftest import SIZE, saddle_windows
from tests.image.board.test_saddle_model import plain_formula


@pytest.fixture
def windows(corners) -> Windows:
    pixels = saddle_windows(*corners)
    mask = torch.rand(pixels.shape) < 0.8
    return Windows.of_pixels(pixels + 3 * torch.randn_like(pixels), mask)


@pytest.fixture
def start(corners) -> SaddleParameters:
    _, angles, blur = corners
    return SaddleParameters.at_centre(angles, torch.full_like(blur, 120.0), torch.full_like(blur, 90.0))


def test_windows_with_missing_pixels_are_zero_and_incomplete():
    pixels = torch.ones(3, 5, 5).double()
    pixels[1, 2, 2] = torch.nan
    mask = torch.ones(3, 5, 5, dtype=torch.bool)
    mask[2, 0] = False
    windows = Windows.of_pixels(pixels, mask)
    assert windows.complete.tolist() == [True, False, True]
    assert windows.values.sum(-1).tolist() == [25, 0, 20]
    assert windows.grid[:, 0].tolist() == [-2, -2]
    assert windows.grid[:, 5].tolist() == [-2, -1]


def test_linearisation_is_weighted(windows, start):
    current = Linearisation.of(windows, start, FULL)
    for i in range(0, len(windows.values), 9):
        values = plain_formula(start.columns[i], windows.grid)
        residual = windows.weight[i] * (windows.values[i] - values)
        torch.testing.assert_close(current.residual[i], residual, rtol=0, atol=1e-10)
        torch.testing.assert_close(current.cost[i], residual.square().sum())
        by_autograd = torch.func.jacrev(lambda p: plain_formula(p, windows.grid))(start.columns[i])
        torch.testing.assert_close(current.jacobian[i].mT, windows.weight[i, :, None] * by_autograd, rtol=0, atol=1e-9)


def test_damped_step_solves_the_normal_equations():
    jacobian = torch.randn(4, 5, 30).double() * torch.tensor([1e-3, 1.0, 10.0, 1e3, 1.0]).double()[:, None]
    gradient, damping = torch.randn(4, 5).double(), torch.tensor([0.0, 1e-3, 1.0, 100.0]).double()
    normal = jacobian @ jacobian.mT
    damped = normal + damping[:, None, None] * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
    matrix = NormalMatrix.of(jacobian)
    torch.testing.assert_close(matrix.damped_solution(gradient, damping), torch.linalg.solve(damped, gradient))
    torch.testing.assert_close(matrix.inverse(), torch.linalg.inv(normal))


@pytest.mark.parametrize("model", [PLAIN, FULL], ids=["plain", "full"])
def test_nothing_near_the_minimum_is_better(windows, start, model):
    fitted = fit_parameters(windows, start, model, smallest_step_px=1e-9, iterations=40)
    frozen = [column for column in range(17) if column not in model.free]
    assert torch.equal(fitted.columns[:, frozen], start.columns[:, frozen])
    best = Linearisation.of(windows, fitted.parameters, model)
    for column in model.free:
        for step in (-1e-3, 1e-3):
            moved = fitted.columns.clone()
            moved[:, column] += step
            assert (Linearisation.of(windows, SaddleParameters(moved), model).cost > best.cost).all()


def test_no_step_makes_a_fit_worse(windows, start):
    cost = Linearisation.of(windows, start, FULL).cost
    for iterations in range(1, 6):
        fitted = fit_parameters(windows, start, FULL, smallest_step_px=0.0, iterations=iterations)
        latest = Linearisation.of(windows, fitted.parameters, FULL).cost
        assert (latest <= cost).all()
        cost = latest


def test_a_blur_at_the_end_of_its_range_delays_no_fit(corners, start):
    position, _, blur = corners
    columns = start.columns.clone()
    columns[:, :2], columns[:, 4] = 0.3 * position, 0.01  # no blur at all but that of the pixels
    grid = pixel_grid(SIZE, columns)
    pixels = Saddle.on_grid(SaddleParameters(columns), grid).values() + torch.randn(len(blur), SIZE**2).double()
    windows = Windows(pixels, torch.ones_like(pixels), grid, torch.ones(len(blur), dtype=torch.bool))
    plain = fit_parameters(windows, start, PLAIN, smallest_step_px=1e-2, iterations=12).parameters
    few, many = (fit_parameters(windows, plain, FULL, smallest_step_px=0.0, iterations=n).parameters for n in (5, 60))
    assert (many.blur == 0.1).sum() > 10
    assert (few.position - many.position).abs().max() < 1e-4


def test_the_inverse_of_a_singular_matrix_is_its_pseudo_inverse():
    jacobian = torch.randn(3, 4, 20).double()
    jacobian[1, 2] = jacobian[1, 0]
    jacobian[2] = 0
    inverse = NormalMatrix.of(jacobian).inverse()
    for ours, rows in zip(inverse, jacobian, strict=True):
        length = torch.linalg.vector_norm(rows, dim=-1)
        length = torch.where(length > 0, length, 1.0)
        scaled = rows / length[:, None]
        torch.testing.assert_close(ours, torch.linalg.pinv(scaled @ scaled.mT) / length / length[:, None])


def test_a_window_of_one_value_stays_finite():
    flat = Windows.of_pixels(torch.full((1, SIZE, SIZE), 7.0).double(), torch.ones(1, SIZE, SIZE, dtype=torch.bool))
    angles = torch.tensor([[0.0, 1.5]]).double()
    start = SaddleParameters.at_centre(angles, torch.tensor([7.0]).double(), torch.tensor([0.0]).double())
    assert fit_parameters(flat, start, FULL, smallest_step_px=1e-5, iterations=5).columns.isfinite().all()
