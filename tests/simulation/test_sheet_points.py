"""Errors of points of a sheet, and what of them is no shear."""

import pytest
import torch

from lsvision.simulation.sheet_points import SheetPoints

POINTS = torch.cat([torch.cartesian_prod(*2 * [torch.linspace(0, 300, 7).double()]), torch.zeros(49, 1).double()], 1)


def test_a_shear_by_y_is_no_error_but_for_it() -> None:
    sheared = POINTS.clone()
    sheared[:, 0] += 1e-3 * POINTS[:, 1]
    found = SheetPoints(POINTS, sheared, torch.zeros(49))
    assert found.rms_mm > 0.1
    assert found.unsheared_rms_mm == pytest.approx(0.0, abs=1e-9)


def test_a_wave_along_y_stays() -> None:
    waving = POINTS.clone()
    waving[:, 0] += 0.2 * torch.tensor([1.0, -2.0, 1.0, 0.0, -1.0, 2.0, -1.0]).double().repeat(7)
    found = SheetPoints(POINTS, waving, torch.zeros(49))
    assert found.unsheared_rms_mm == pytest.approx(found.rms_mm, rel=0.02)
