"""The covariance of corners from correlated noise: against dense matrices, and against noise that is known."""

import math

import pytest
import torch
from torch import Tensor

from lsvision.image.board.correlated_noise import (
    BoardNoise,
    corner_covariance,
    expected_products,
    nonnegative_solution,
    possible_covariance,
)
from lsvision.image.board.noise_kinds import Correlation
from lsvision.image.board.residuals import Residuals
from lsvision.image.board.saddle import fit_saddles
from tests.image.board.conftest import saddle_windows

SIZE = 7


def random_residuals(fits: int = 3) -> Residuals:
    weight = (torch.rand(fits, SIZE**2) > 0.2).double()
    jacobian = torch.randn(fits, 4, SIZE**2, dtype=torch.float64) * weight[:, None]
    influence = torch.linalg.inv(jacobian @ jacobian.mT)[:, :2] @ jacobian
    residual = torch.randn(fits, SIZE**2, dtype=torch.float64) * weight
    return Residuals(residual, weight, jacobian, influence, torch.rand(fits, 2, dtype=torch.float64) - 0.5)


def dense(first: Residuals, second: Residuals, fit: int) -> Tensor:
    """Covariance matrices of all kinds of noise between the pixels of two windows, number by number."""
    axis = torch.arange(SIZE).double()
    v, u = (x.flatten() for x in torch.meshgrid(axis, axis, indexing="ij"))
    shift = second.corner[fit] - first.corner[fit]
    du, dv = u[:, None] - u + shift[0], v[:, None] - v + shift[1]
    box = (1 - du.abs()).clamp(min=0) * (1 - dv.abs()).clamp(min=0)
    wide = [torch.exp(-0.5 * (du.square() + dv.square()) / s**2) for s in (1.0, 2.0, 4.0)]
    edges = first.steepness[fit][:, None] * box * second.steepness[fit]
    same_line = (1 - dv.abs()).clamp(min=0)
    shifts = [first.jacobian[fit, axis][:, None] * same_line * second.jacobian[fit, axis] for axis in (0, 1)]
    return torch.stack([box, *wide, *shifts, edges])


def left_over(fits: Residuals, fit: int) -> Tensor:
    jacobian = fits.jacobian[fit]
    return fits.weight[fit].diag() - jacobian.mT @ torch.linalg.inv(jacobian @ jacobian.mT) @ jacobian


def test_products_equal_those_of_dense_matrices():
    first, second = random_residuals(), random_residuals()
    correlation = Correlation.between(first, second, torch.float64)
    applied = correlation.times(second.influence)
    expected = torch.zeros(7, 7).double()
    for fit in range(3):
        kinds = dense(first, second, fit)
        torch.testing.assert_close(applied[:, fit].mT, kinds @ second.influence[fit].mT, rtol=0, atol=1e-12)
        seen = left_over(first, fit) @ kinds @ left_over(second, fit)
        expected += torch.einsum("kij, lij -> kl", seen, kinds)
    torch.testing.assert_close(expected_products(first, second, correlation), expected, rtol=0, atol=1e-10)
    both = Correlation.between(first, first, torch.float64)
    torch.testing.assert_close(
        expected_products(first, first, both), expected_products(first, first.of(slice(0, 3)), both)
    )


def test_nonnegative_solution():
    root = torch.randn(4, 6, dtype=torch.float64)
    matrix = root @ root.mT
    inside = torch.tensor([0.5, 1.0, 2.0, 0.1]).double()
    torch.testing.assert_close(nonnegative_solution(matrix, matrix @ inside), inside)
    # By hand: the free minimum (2, -1) of a circle lies nearest to (2, 0).
    circle = nonnegative_solution(torch.eye(2).double(), torch.tensor([2.0, -1.0]).double())
    assert circle.tolist() == [2.0, 0.0]
    assert nonnegative_solution(torch.eye(2).double(), -torch.ones(2).double()).tolist() == [0.0, 0.0]


def test_a_possible_covariance_is_left_and_an_impossible_one_reduced():
    first, second = torch.tensor([[2.0, 0.3], [0.3, 1.0]]).double()[None], 4 * torch.eye(2).double()[None]
    small = torch.tensor([[0.4, 0.1], [-0.2, 0.3]]).double()[None]
    torch.testing.assert_close(possible_covariance(small, first, second), small)
    reduced = possible_covariance(30 * small, first, second)
    whole = torch.cat([torch.cat([first, reduced], -1), torch.cat([reduced.mT, second], -1)], -2)
    assert torch.linalg.eigvalsh(whole).min() > 0


def noisy_fits(count: int, size: int, noise: float, texture: float, width: float):
    """Fits of pairs of images: a texture that both show, as wide as told, and noise of each."""
    position = torch.zeros(count, 2).double()
    angles = torch.tensor([0.3, 0.3 + 1.6]).double().expand(count, 2)
    clean = saddle_windows(position, angles, torch.ones(count).double())
    reach = math.ceil(3 * width)
    axis = torch.arange(-reach, reach + 1).double()
    kernel = torch.exp(-0.5 * (axis / max(width, 1e-3)).square())
    kernel = kernel / kernel.square().sum().sqrt()
    field = torch.randn(count, 1, size + 2 * reach, size + 2 * reach, dtype=torch.float64)
    field = torch.nn.functional.conv2d(field, kernel.reshape(1, 1, 1, -1))
    field = torch.nn.functional.conv2d(field, kernel.reshape(1, 1, -1, 1))[:, 0]
    return [fit_saddles(clean + texture * field + noise * torch.randn_like(clean), angles) for _ in range(2)]


@pytest.mark.parametrize(
    ("texture", "width"),
    [(0.0, 1.0), (6.0, 1.5), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((6.0, 0.5), (3.0, 3.0)))],
)
def test_chi_square_of_the_difference_and_the_mean_of_two_images(texture, width):
    left, right = noisy_fits(500, 17, 3.0, texture, width)
    every = torch.ones(500, dtype=torch.bool)
    noise = [BoardNoise.of(fit.residuals, every) for fit in (left, right)]
    own = [each.covariance(every) for each in noise]
    shared = possible_covariance(noise[0].covariance_with(noise[1], every), *own)
    for error, covariance in (
        (left.position, own[0]),
        (left.position - right.position, own[0] + own[1] - shared - shared.mT),
        (left.position + right.position, own[0] + own[1] + shared + shared.mT),
    ):
        squared = (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)
        assert 1.7 < squared.mean() < 2.35
    if texture == 0:
        white = left.covariance.diagonal(dim1=-2, dim2=-1).mean()
        assert abs(own[0].diagonal(dim1=-2, dim2=-1).mean() / white - 1) < 0.05
        assert shared.diagonal(dim1=-2, dim2=-1).mean().abs() < 0.1 * white


@pytest.mark.parametrize(("sideways", "along"), [(0.05, 0.0), (0.4, 0.0), (0.0, 0.3)])
@pytest.mark.parametrize("angle", [0.05, 0.3])
def test_chi_square_where_each_line_is_shifted(sideways, along, angle):
    angles = torch.tensor([angle, angle + 1.6]).double().expand(200, 2)
    shift = torch.tensor([sideways, along]) * torch.randn(200, 17, 2, dtype=torch.float64)
    clean = saddle_windows(torch.zeros(200, 2).double(), angles, torch.full((200,), 0.8).double(), line_shift=shift)
    fit = fit_saddles(clean + 2 * torch.randn_like(clean), angles)
    noise = BoardNoise.of(fit.residuals, torch.ones(200, dtype=torch.bool))
    squared = (fit.position * torch.linalg.solve(noise.covariance(fit.valid), fit.position[..., None])[..., 0]).sum(-1)
    assert 1.6 < squared.mean() < 2.4
    expected = torch.tensor([sideways, along]).double().square()  # of small shifts; the blur takes a part of large ones
    torch.testing.assert_close(noise.strength[4:6], expected, rtol=0.3, atol=1e-3)


def test_a_smooth_motion_of_lines_is_no_noise():
    """A quarter of a pixel at the ends of the window, of a vibration of some 90 lines: calibrations find it."""
    angles = torch.tensor([0.1, 1.7]).double().expand(200, 2)
    phase = 2 * math.pi * torch.rand(200, 1, dtype=torch.float64)
    wave = torch.sin(2 * math.pi / 90 * torch.arange(17) + phase)
    shift = torch.stack([1.5 * wave, 0 * wave], -1)
    shift = shift - shift[:, 8:9]
    clean = saddle_windows(torch.zeros(200, 2).double(), angles, torch.full((200,), 0.8).double(), line_shift=shift)
    fit = fit_saddles(clean + 2 * torch.randn_like(clean), angles)
    noise = BoardNoise.of(fit.residuals, torch.ones(200, dtype=torch.bool))
    assert noise.strength[4:6].tolist() == [0.0, 0.0]


def test_windows_of_different_size_are_compared_in_their_middle():
    left, right = (fit.residuals for fit in noisy_fits(20, 17, 3.0, 3.0, 1.5))
    smaller = left.cropped(13)
    assert smaller.size == 13
    assert torch.equal(smaller.residual[0].reshape(13, 13), left.residual[0].reshape(17, 17)[2:15, 2:15])
    every = torch.ones(20, dtype=torch.bool)
    whole, middle = BoardNoise.of(left, every), BoardNoise.of(right.cropped(13), every)
    torch.testing.assert_close(whole.covariance_with(middle, every), middle.covariance_with(whole, every).mT)


def test_what_images_share_is_at_most_what_either_has_and_no_error_of_edges():
    left, _ = noisy_fits(20, 17, 3.0, 3.0, 1.5)
    every = torch.ones(20, dtype=torch.bool)
    noise = BoardNoise(left.residuals, torch.tensor([1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 40.0]).double())
    faint = BoardNoise(left.residuals, torch.tensor([0.25, 2.0, 0.0, 0.0, 0.0, 0.0, 40.0]).double())
    allowed = corner_covariance(
        left.residuals, left.residuals, torch.tensor([0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]).double()
    )
    shared = noise.covariance_with(faint, every)
    assert (torch.linalg.eigvalsh(allowed - shared) > -1e-12).all()
