"""Held-out lines of a record of real jitter, predicted by the smoother with parameters from the others alone."""

import gzip
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lsvision.estimation import NoisyValues, SignalParameters, fit_signals, smooth_signals

AROUND = 31  # lines, over which an outlier is one


def record(shared_data: Path) -> tuple[Tensor, Tensor]:
    """Displacement by line, px, and whether it was measured; outliers over 4 local MAD count as not measured."""
    with gzip.open(shared_data / "line_jitter" / "limb-shift-real.csv.gz", "rt") as file:
        rows = torch.tensor([[float(part) for part in row.split(";")] for row in file], dtype=torch.float64)
    measured = (rows[:, 2] > 0).nonzero()[:, 0]
    values = rows[measured, 1]

    def local_median(of: Tensor) -> Tensor:
        half = AROUND // 2
        return torch.cat([of[:half], of, of[-half:]]).unfold(0, AROUND, 1).median(-1).values

    off = (values - local_median(values)).abs()
    measured = measured[off <= 4 * 1.4826 * local_median(off)]
    first, end = int(measured[0]), int(measured[-1]) + 1
    valid = torch.zeros(len(rows), dtype=torch.bool).index_fill_(0, measured, True)
    return rows[first:end, 1], valid[first:end]


@pytest.mark.slow
def test_held_out_lines_are_predicted_as_well_as_the_sigma_says(shared_data: Path) -> None:
    values, valid = record(shared_data)
    good = valid.nonzero()[:, 0]
    start = SignalParameters(2, *(torch.tensor([value]).double() for value in (1.5, 5.0, 0.3, 0.05)))
    free = torch.tensor([1.0, 1.0, 1.0, 0.0])  # neighbouring lines were measured independently of each other
    squares, normalised = [], []
    for phase in range(5):
        held = good[phase::5]
        known = valid.index_fill(0, held, False)
        level = values[known].median()
        data = NoisyValues(values[:, None] - level, torch.ones(len(values), 1, 1).double(), known)
        pieces = data.at(torch.arange(256)[:, None] + 256 * torch.arange(-(-len(values) // 256)))
        start = fit_signals(start, pieces, lambda at: at.sigma.new_zeros(len(at.sigma)), free, iterations=6).parameters
        mean, covariance = smooth_signals(start.model(), data, block=256, halo=64)
        off = values[held] - level - mean[held, 0]
        squares.append(off.square().mean())
        normalised.append((off.square() / (covariance[held, 0, 0] + start.noise_scale**2)).mean())
    assert torch.stack(squares).mean().sqrt() <= 0.41
    assert 0.9 <= torch.stack(normalised).mean() <= 1.1
