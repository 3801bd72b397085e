"""Regions seen strip by strip are those of the whole."""

import cv2
import numpy as np
import pytest
import torch

from lsvision.stages.surface.regions import FITS, Regions, Strip


def strip(row, mask, value):
    return Strip(row, mask, value.abs(), value, -value, lambda rows, cells: rows.new_zeros(FITS, len(rows)).double())


@pytest.mark.parametrize("step", [1, 3, 7, 40])
def test_strips_of_any_height_give_the_regions_of_the_whole(step):
    generator = torch.Generator().manual_seed(3)
    value = torch.randn(40, 30, generator=generator)
    mask = value > 0.2
    regions = Regions()
    for row in range(0, 40, step):
        regions.add(strip(row, mask[row : row + step], value[row : row + step]))
    table = regions.table()
    count, labels = cv2.connectedComponents(mask.numpy().astype(np.uint8), connectivity=8)
    assert len(table["cells"]) == count - 1 > 5
    expected = sorted(
        (int((labels == label).sum()), float(value[torch.from_numpy(labels == label)].sum()))
        for label in range(1, count)
    )
    found = sorted(zip(table["cells"].int().tolist(), table["value"].tolist(), strict=True))
    assert found == [(cells, pytest.approx(total, abs=1e-4)) for cells, total in expected]


def test_ends_and_peak_of_a_region_over_a_border():
    value = torch.zeros(6, 8)
    value[1:5, 2:4] = torch.tensor([[1.0, 2.0], [3.0, 4.0], [9.0, 1.0], [1.0, 1.0]])
    regions = Regions()
    for row in (0, 3):
        regions.add(strip(row, value[row : row + 3] > 0, value[row : row + 3]))
    table = {name: of.tolist() for name, of in regions.table().items()}
    assert (table["first_row"], table["last_row"], table["first_cell"], table["last_cell"]) == ([1], [4], [2], [3])
    assert (table["ratio"], table["peak_row"], table["peak_cell"]) == ([9], [3], [2])
    assert table["cells"] == [8]


def test_nothing_stands_out():
    regions = Regions()
    regions.add(strip(0, torch.zeros(4, 5, dtype=torch.bool), torch.zeros(4, 5)))
    assert all(len(of) == 0 for of in regions.table().values())
