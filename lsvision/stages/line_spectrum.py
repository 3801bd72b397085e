"""Which wavelengths along the travel a motion from line to line consists of."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_OUTSIDE = 0.05  # share of the power at shorter, and at longer wavelengths than the band's


@dataclass(frozen=True)
class LineSpectrum:
    """Amplitudes by wavelength along the travel, longest first.

    A sine of a wavelength peaks at its amplitude there, in the unit of the values; a Hann window keeps what is longer
    than the scan from spilling over.
    """

    wavelength_mm: Float[Tensor, " waves"]
    amplitude: Float[Tensor, "waves components"]

    @classmethod
    def of(cls, values: Float[Tensor, "lines components"], pitch_mm: float) -> "LineSpectrum":
        """Spectrum of values on lines a pitch apart."""
        lines = len(values)
        window = torch.hann_window(lines, periodic=False, dtype=values.dtype, device=values.device)
        waves = torch.fft.rfft((values - values.mean(0)) * window[:, None], dim=0)[1:]
        frequency = torch.fft.rfftfreq(lines, pitch_mm, dtype=values.dtype, device=values.device)[1:]
        tiny = torch.finfo(values.dtype).tiny
        return cls(1 / frequency, 2 * waves.abs() / window.sum().clamp(min=tiny))


def band_of_power(values: Float[Tensor, "lines components"], pitch_mm: float) -> tuple[float, float] | None:
    """Shortest and longest wavelength, mm, between which nine tenths of the power of each component lie.

    Each component counts by itself, whatever its unit; the band holds that of every one that is not zero.

    Returns:
        None where nothing moves.
    """
    spectrum = LineSpectrum.of(values, pitch_mm)
    power = spectrum.amplitude.square()
    power = power[:, power.sum(0) > 0]
    if power.numel() == 0:
        return None
    share = power.cumsum(0) / power.sum(0)
    last = len(share) - 1
    longest = (share < _OUTSIDE).sum(0).clamp(max=last).min()
    shortest = (share < 1 - _OUTSIDE).sum(0).clamp(max=last).max()
    return float(spectrum.wavelength_mm[shortest]), float(spectrum.wavelength_mm[longest])
