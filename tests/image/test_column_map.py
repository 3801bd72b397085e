"""The map of columns of a lens: a polynomial that is the table, between whole columns as well."""

import torch

from lsvision.geometry import Rectification
from lsvision.image.column_map import ColumnMap
from tests.raw_cameras import RAW


def test_columns_between_whole_ones_lie_between_their_places():
    places = torch.linspace(0, 10, 30, dtype=torch.float64).square()
    found = ColumnMap.of(places)(torch.tensor([0.0, 3.5, 29.0, torch.nan, 30.0]))
    step = 10 / 29
    expected = torch.tensor([0.0, (3.5 * step) ** 2, 100.0, torch.nan, (30 * step) ** 2])
    torch.testing.assert_close(found, expected, equal_nan=True, atol=1e-4, rtol=0)


def test_the_map_of_a_lens_is_its_table():
    rectification = Rectification.of(RAW)
    assert rectification is not None
    places = rectification.raw_left_columns
    columns = torch.arange(len(places), dtype=torch.float64)
    shown = ColumnMap.of(places)
    assert float((shown(columns) - places).abs().max()) < 1e-4
    assert float((shown(columns.float()).double() - places).abs().max()) < 6e-4
    between = rectification.raw_column(columns[:-1] + 0.5)
    assert float((shown(columns[:-1] + 0.5) - between).abs().max()) < 1e-4


def test_a_part_of_a_tile_has_its_bits():
    shown = ColumnMap.of(torch.linspace(3, 900, 893, dtype=torch.float64) ** 1.01)
    columns = 892 * torch.rand(37, 53)
    assert torch.equal(shown(columns[5:20, 3:50]), shown(columns)[5:20, 3:50])
