"""A calibrated rig as the data sheet of another calibration: the boards of both count once, and all of them."""

from dataclasses import replace

import pytest
import torch

from lsvision.geometry import quantities_of
from lsvision.stages.rig.calibrate import calibrate_rig
from lsvision.stages.rig.model import RigPrior
from lsvision.types import RawRig, RigCalibration
from tests.stages.rig.boards import CONFIG, DATA_SHEET, Truth, first_of, restated

FIRST, SECOND = [0, 3, 5, 6], [1, 2, 4, 7]  # either half of the design has every tilt, side and depth


def calibrated(sightings, rig: RawRig) -> RigCalibration:
    """Without the repetition for every board."""
    names = [f"s{i}" for i in range(sightings.boards)]
    return calibrate_rig(sightings, names, rig, replace(CONFIG, held_out=False))


def sigma_of(rig: RawRig) -> torch.Tensor:
    assert rig.covariance is not None
    return torch.tensor(rig.covariance, dtype=torch.float64).diagonal().sqrt()


@pytest.mark.slow
def test_a_second_calibration_goes_on_where_the_first_ended():
    """Sigmas are stated a little large: no scale of the noise is then estimated, which few boards have of their own.

    What remains is n, which the second calibration begins anew. With the sigmas alone it would not do.
    """
    sightings = first_of(restated(Truth.drawn(1).scanned(8), 1.1))
    first, at_once = calibrated(sightings.chosen(FIRST), DATA_SHEET), calibrated(sightings, DATA_SHEET)
    by_covariance = calibrated(sightings.chosen(SECOND), first.rig)
    by_sigmas = calibrated(sightings.chosen(SECOND), replace(first.rig, covariance=None))
    near, far = (
        (quantities_of(found.rig) - quantities_of(at_once.rig)) / sigma_of(at_once.rig)
        for found in (by_covariance, by_sigmas)
    )
    assert float(near.abs().max()) < 0.15
    assert float(far.abs().max()) > 0.5
    assert float((sigma_of(by_covariance.rig) / sigma_of(at_once.rig) - 1).abs().max()) < 0.02
    assert by_covariance.verdict == at_once.verdict == "determined"


def test_the_prior_has_the_covariance_of_the_rig_file():
    first = calibrated(first_of(Truth.drawn(1).scanned(4)), DATA_SHEET)
    prior = RigPrior.of(first.rig, CONFIG)
    covariance, sigma = torch.tensor(first.rig.covariance, dtype=torch.float64), sigma_of(first.rig)
    found = (prior.root @ prior.root.mT)[:14, :14]
    assert float(((found - covariance) / torch.outer(sigma, sigma)).abs().max()) < 1e-12
    torch.testing.assert_close(prior.sigma[:14], sigma)
    assert prior.sigma[14:].tolist() == [CONFIG.motion_sigma] * 3


def test_what_the_data_sheet_calls_exact_stays():
    rig = replace(DATA_SHEET, sigma=(("baseline_mm", 0.0),))
    found = calibrated(first_of(Truth.drawn(1).scanned(4)), rig)
    assert found.rig.baseline_mm == DATA_SHEET.baseline_mm
    assert all("baseline" not in item.in_words for item in found.unobserved)
    assert dict(found.rig.sigma)["baseline_mm"] == 0.0
