"""Corners that are dropped: too large a residual, unevenly clipped windows, out of line with their neighbours."""

import dataclasses

import pytest
import torch
from torch import Tensor

from lsvision.image.board.outliers import evenly_clipped, in_line_with_neighbours, like_the_board
from lsvision.image.board.saddle import SaddleFit, fit_saddles
from tests.image.board.conftest import random_corners, saddle_windows

ALL = torch.ones(88, dtype=torch.bool)


def board_of_fits() -> SaddleFit:
    position, angles, _ = random_corners(88)
    windows = saddle_windows(position, angles, torch.ones(88).double())
    return fit_saddles(windows + 2 * torch.randn_like(windows), angles)


def test_a_larger_residual_is_no_corner_unless_light_or_contrast_explains_it():
    fit = board_of_fits()
    assert torch.equal(like_the_board(fit, ALL), ALL)
    residual = fit.residual.clone()
    residual[7] *= 1.6
    assert like_the_board(dataclasses.replace(fit, residual=residual), ALL).logical_not().nonzero().tolist() == [[7]]
    # Texture of a brighter part, and noise of the sensor in a darker one.
    bright, dark = fit.residual.clone(), fit.contrast.clone()
    bright[:20] *= 1.8
    more = fit.contrast.clone()
    more[:20] *= 1.8
    dark[20:40] *= 0.5
    assert like_the_board(dataclasses.replace(fit, residual=bright, contrast=more), ALL).all()
    assert like_the_board(dataclasses.replace(fit, contrast=dark), ALL).all()


def test_unevenly_clipped_windows():
    windows = torch.full((88, 7, 7), 40.0).double()
    mask = torch.ones_like(windows, dtype=torch.bool)
    windows[0, 0, 0] = 250.0  # bright, but within the range of a byte
    assert evenly_clipped(windows, mask, ALL).all()
    windows[3, :3] = 255.0
    assert evenly_clipped(windows, mask, ALL).logical_not().nonzero().tolist() == [[3]]
    windows[:, :3] = 255.0  # all white squares are
    windows[5, :5] = 255.0
    windows[6] = 40.0
    assert evenly_clipped(windows, mask, ALL).logical_not().nonzero().tolist() == [[5]]
    twelve_bits = torch.where(windows == 255, 4095.0, windows)
    assert torch.equal(evenly_clipped(twelve_bits, mask, ALL), evenly_clipped(windows, mask, ALL))


def curved_grid() -> Tensor:
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(11.0), indexing="ij")
    u = 50 + 27 * x - 3 * y + 0.2 * x * y + 0.02 * x**3
    return torch.stack([u, 40 + 4 * x + 26 * y + 0.1 * y**2], dim=-1).double() + 0.02 * torch.randn(8, 11, 2).double()


def test_a_corner_out_of_line_with_its_neighbours():
    grid = curved_grid()
    assert in_line_with_neighbours(grid, ALL).all()
    for places in ([(3, 4)], [(0, 5)], [(4, 10), (7, 3)], [(2, 2), (2, 3)]):
        moved = grid.clone()
        for row, column in places:
            moved[row, column, 0] += 1.5
        wrong = in_line_with_neighbours(moved, ALL).logical_not().nonzero()[:, 0]
        assert wrong.tolist() == sorted(11 * row + column for row, column in places)


def test_under_vibration_all_corners_are_out_of_line_and_stay():
    grid = curved_grid()
    line = torch.arange(8.0)[:, None] * 3.0 + torch.arange(11.0) * 0.4
    grid[..., 0] += 2.0 * torch.sin(line.double())
    assert in_line_with_neighbours(grid, ALL).all()


@pytest.mark.parametrize("yaw", [0.0, 0.06, 0.25])
def test_a_vibration_that_moves_whole_rows_costs_no_corner(yaw):
    for _ in range(20):
        grid = curved_grid()
        travel = 30.0 * (torch.arange(8.0)[:, None] + yaw * torch.arange(11.0)).double()
        phase = 2 * torch.pi * torch.rand(3).double()
        waves = torch.sin(2 * torch.pi * travel[..., None] / torch.tensor([233.0, 97.0, 61.0]).double() + phase)
        grid[..., 0] += 1.8 * waves.sum(-1)  # 0.6 mm rms in pixels of 0.28 mm
        assert in_line_with_neighbours(grid, ALL).all()


def test_a_wrong_corner_beside_a_hidden_one_at_the_rim():
    grid, valid = curved_grid(), ALL.clone()
    valid[5] = False
    grid[0, 6] += 3.0
    kept = in_line_with_neighbours(grid, valid)
    assert not kept[6]
    assert int(kept.sum()) == 86


@pytest.mark.parametrize("corner", [0, 10, 77, 87])
def test_a_corner_of_the_board_itself(corner):
    grid = curved_grid()
    grid[corner // 11, corner % 11, 0] += 3.0
    assert in_line_with_neighbours(grid, ALL).logical_not().nonzero().tolist() == [[corner]]


def test_missing_neighbours_cost_no_corner():
    valid = torch.rand(88) > 0.4
    grid = torch.where(valid.reshape(8, 11, 1), curved_grid(), torch.nan)
    assert torch.equal(in_line_with_neighbours(grid, valid), valid)
    few = torch.zeros(88, dtype=torch.bool)
    few[:5] = True
    assert torch.equal(in_line_with_neighbours(grid, few), few)
