"""Which places count as beside a step, counted by hand."""

import pytest
import torch

from lsvision.image.stereo.residuals import Misfit
from lsvision.image.stereo.steps import step_beside

ROWS, COLUMNS = 40, 120


def beside(disparity: torch.Tensor, misfit: float, block: int = 1) -> torch.Tensor:
    return step_beside(disparity, torch.full_like(disparity, misfit), block)[ROWS // 2]


def step(height: float = 20.0) -> torch.Tensor:
    disparity = torch.zeros(ROWS, COLUMNS)
    disparity[:, 60:] = height
    return disparity


@pytest.mark.parametrize(
    ("misfit", "block", "columns"),
    [(1.0, 1, []), (2.0, 1, [*range(58, 65)]), (8.0, 1, [*range(58, 84)]), (2.0, 2, [*range(59, 63)])],
)
def test_reach_of_a_step_grows_with_the_misfit(misfit, block, columns):
    height = beside(step(), misfit, block)
    assert height.nonzero()[:, 0].tolist() == columns
    assert set(height.tolist()) <= {0.0, 20.0}


def test_neither_a_slope_nor_a_small_step_counts():
    slope = (0.15 * torch.arange(COLUMNS).float()).expand(ROWS, COLUMNS).contiguous()
    assert not beside(slope, 2.0).any()
    assert not beside(step(0.9), 8.0).any()


def test_a_gap_belongs_to_what_lies_behind_it():
    disparity = step()
    disparity[:, 45:60] = torch.nan
    assert beside(disparity, 2.0)[60:].nonzero()[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_nothing_known_is_no_step():
    assert not step_beside(torch.full((8, 8), torch.nan), torch.ones(8, 8), 1).any()


def test_misfit_is_counted_from_the_usual_variance():
    variance = torch.full((128, 256), 2.0)
    variance[:, 144:] = 6.0  # a brighter part, with noise of its own
    variance[40:44, 40:44] = variance[40:44, 240:244] = 96.0
    misfit = Misfit.of(variance, 1)
    assert misfit.share[41, 41] == 48.0
    assert misfit.share[41, 241] == 16.0
    assert misfit.factor[41, 41] == 2.0
    assert misfit.factor[0, 0] == misfit.factor[0, 200] == 1.0
