"""The study of raw rigs: what it compares errors with, and that a calibration with the right prior reaches it."""

import dataclasses

import pytest
import torch

from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.model import RigPrior
from lsvision.study.rig_bound import information_of_corners, least_factor
from lsvision.study.rig_runs import RigSampling, run_rigs
from lsvision.study.rig_scans import RigConditions, rig_scans
from tests.stages.rig.boards import BOARD, CONFIG, DATA_SHEET, PRIOR

NARROW = RigPrior.of(
    DATA_SHEET, dataclasses.replace(CONFIG, focal_length_share=0.005, turn_sigma_deg=0.3, principal_sigma_px=1.0)
)


@pytest.mark.slow
def test_a_calibration_that_expects_the_rigs_it_gets_reaches_the_bound():
    points = run_rigs([RigConditions(boards=4)], PRIOR, PRIOR, BOARD, CONFIG, RigSampling(24))
    row = points.row(0, named=True)
    assert 0.75 < row["over_bound"] < 1.25
    assert abs(row["nees"] - row["unknowns"]) < row["nees_band"]
    assert row["within_3_sigma"] > 0.985


def test_the_bound_is_the_posterior_of_a_linear_problem():
    """Where the rigs hardly differ, corners are linear in them: information adds up, and off scales what is drawn."""
    information = 3.0 * torch.eye(17, dtype=torch.float64)
    torch.testing.assert_close(least_factor(information, 1.0), 0.5 * torch.eye(17, dtype=torch.float64))
    far = least_factor(information, 10.0)
    torch.testing.assert_close(far.diagonal(), torch.full((17,), 10 / 301**0.5, dtype=torch.float64))


def test_rigs_drawn_closer_have_a_lower_bound():
    bounds = []
    for drawn in (PRIOR, NARROW):
        torch.manual_seed(1)
        scans = rig_scans(drawn, BOARD, RigConditions(boards=4), 3)
        least = drawn.root @ least_factor(information_of_corners(scans, drawn), 1.0)
        shape = HeightShape.of(DATA_SHEET, drawn.shared(torch.zeros(17, dtype=torch.float64)), PRIOR.sigma, 52.0)
        bounds.append(shape.stated_mm(PRIOR.over_sigma(least.mT).mT).square().mean())
    assert float(bounds[1]) < float(bounds[0])
