"""Factors of sigma against errors of independent pixels that are smoothed as the refinement smooths them."""

import pytest
import torch

from lsvision.image.stereo.scatter import SigmaGains, with_scatter
from lsvision.image.stereo.windows import Windows


@pytest.mark.parametrize(("window", "iterations"), [(5, 1), (9, 1), (9, 2), (7, 3)])
def test_gains_are_those_of_independent_errors(window, iterations):
    windows = Windows.over(torch.ones(400, 400, dtype=torch.bool), window)
    noise = torch.randn(400, 400)
    single = windows.mean(noise)
    error = torch.zeros_like(noise)
    for _ in range(iterations):
        smooth = windows.mean(error)
        error = smooth - windows.mean(smooth) + single
    inside = (slice(40, -40), slice(40, -40))
    rms = {
        name: float(values[inside].square().mean().sqrt())
        for name, values in {
            "single": single,
            "all": error,
            "scatter": error - windows.mean(error),
            "smooth": windows.mean(error - windows.mean(error)),
        }.items()
    }
    gains = SigmaGains.of(window, iterations)
    assert gains.iterations == pytest.approx(rms["all"] / rms["single"], rel=0.02)
    assert gains.scatter == pytest.approx(rms["all"] / rms["scatter"], rel=0.02)
    assert rms["scatter"] ** 2 + gains.wide * rms["smooth"] ** 2 == pytest.approx(rms["all"] ** 2, rel=0.05)


def test_errors_that_alternate_within_a_window_count_as_they_are():
    """Beside an edge the sign of errors alternates: no error wider than a window hides behind their scatter."""
    windows, size = Windows.over(torch.ones(60, 60, dtype=torch.bool), 9), 0.3
    stripes = size * (2.0 * (torch.arange(60) % 2) - 1).expand(60, 60)
    sigma = with_scatter(torch.zeros(60, 60), stripes, windows, SigmaGains.of(9, 1))[20:40, 20:40]
    assert (sigma / size).min() > 0.85
    assert (sigma / size).max() < 1.05


def test_a_plane_scatters_by_nothing_and_a_step_by_no_more_than_its_limit():
    v, u = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    gains, predicted = SigmaGains.of(9, 1), torch.full((40, 60), 0.2)
    for step, least, most in ((0.0, 0.0, 1e-3), (9.0, 0.5, 0.8), (90.0, 0.5, 0.8)):
        disparity = 0.1 * u - 0.05 * v + step * (u >= 30)
        disparity[:, :5] = torch.nan
        sigma = with_scatter(predicted, disparity, Windows.over(disparity == disparity, 9), gains)
        scatter = (sigma.square() - 0.08 * 0.2**2 - 0.01**2).clamp(min=0).sqrt() / gains.scatter
        assert least <= scatter[20, 30] <= most
        assert scatter[20, 45] < 1e-3
