"""Wavelengths of a motion from line to line."""

import pytest
import torch

from lsvision.stages.line_spectrum import LineSpectrum, band_of_power


def sines(lines: int, pitch: float, waves: list[tuple[float, float]]) -> torch.Tensor:
    along = pitch * torch.arange(lines).double()
    return sum(amplitude * torch.sin(2 * torch.pi * along / wavelength + 0.4) for wavelength, amplitude in waves)


@pytest.mark.parametrize("lines", [2000, 2001])
def test_a_sine_peaks_at_its_amplitude(lines):
    spectrum = LineSpectrum.of(sines(lines, 0.07, [(5.0, 0.02)])[:, None], 0.07)
    peak = int(spectrum.amplitude.argmax())
    assert float(spectrum.wavelength_mm[peak]) == pytest.approx(5.0, rel=0.02)
    assert float(spectrum.amplitude[peak]) == pytest.approx(0.02, rel=0.02)
    assert bool((spectrum.wavelength_mm.diff() < 0).all())


def test_the_band_holds_every_component_that_moves():
    quick, slow = sines(4000, 0.5, [(30.0, 1e-4)]), sines(4000, 0.5, [(200.0, 3.0)])
    still = torch.zeros_like(quick)
    shortest, longest = band_of_power(torch.stack([quick, slow, still], 1), 0.5)
    assert shortest == pytest.approx(30.0, rel=0.05)
    assert longest == pytest.approx(200.0, rel=0.15)
    assert band_of_power(torch.stack([still, still], 1), 0.5) is None


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_few_lines(lines):
    values = torch.arange(float(lines)).double()[:, None]
    assert LineSpectrum.of(values, 1.0).amplitude.isfinite().all()
    band = band_of_power(values, 1.0)
    assert band is None or band[0] <= band[1]
