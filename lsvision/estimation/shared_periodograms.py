"""Periodograms of a shared signal, and how likely they are: tapered, with their expectation for what was measured.

Source: Whittle 1953; Sykulski, Olhede, Guillaumin & Lilly 2019, The debiased Whittle likelihood.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.shared_parts import Part
from lsvision.estimation.shared_signal import SharedSignal

_SEGMENT = 4096  # samples of a periodogram, at most
_FIRST_WAVE = 2  # mean and trend are no part of the signal
_BESIDE = 1.7  # cycles in all, beside a wave, at which another may hide
_TAPERED = 0.515  # independent waves of a Hann taper, of all
_USUAL_SPREAD, _LENGTH_SPREAD = 2.5, 1.0  # of the logarithms of sigmas and coherence, and of lengths, beforehand


@dataclass(frozen=True)
class Periodograms:
    """Periodograms of m, d and both, and the autocorrelations of what was measured that their expectation needs.

    Attributes:
        data: the signal. windows: for lags 0, .., n - 1 and then -n, .., -1.
    """

    data: SharedSignal
    periodograms: Sequence[Tensor]
    windows: Sequence[Tensor]

    @property
    def samples(self) -> int:
        """Of a segment."""
        return self.windows[0].shape[-1] // 2

    @property
    def segments(self) -> int:
        """Into which the signal was cut."""
        return len(self.windows[0])

    @classmethod
    def of(cls, data: SharedSignal) -> "Periodograms":
        """Those of a signal, in segments side by side where it is long."""
        count = -(-len(data.total) // _SEGMENT)
        size = len(data.total) // count
        parts = data.at(torch.arange(count * size).view(count, size))
        taper = torch.hann_window(size + 2, periodic=False, dtype=data.total.dtype)[1:-1]
        masks = [taper * valid for valid in (parts.total_valid, parts.difference_valid)]
        values = [
            mask * (part - (mask * part).sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp(min=1e-9))
            for part, mask in zip((parts.total, parts.difference), masks, strict=True)
        ]
        m, d = (torch.fft.rfft(part) for part in values)
        M, D = (torch.fft.rfft(mask, n=2 * size) for mask in masks)
        power = float(taper.square().sum())
        windows = [torch.fft.irfft(part, n=2 * size) / power for part in (M * M.conj(), D * D.conj(), M * D.conj())]
        periodograms = [part[..., _FIRST_WAVE:] / power for part in (m * m.conj(), d * d.conj(), m * d.conj())]
        return cls(data, periodograms, windows)

    def expected(self, part: Part) -> list[Tensor]:
        """Expected periodograms of m, d and both ``(*candidates, segments, waves)`` of a part of the processes."""
        size, ratio = self.samples, self.data.ratio
        lag = torch.arange(-size, size, dtype=part.sigma.dtype).roll(size)
        a, b = (part.covariance(lag, process) for process in range(2))
        later, earlier = a.roll(-1, -1), a.roll(1, -1)
        parts = a + b, ratio**2 * (2 * a - later - earlier), ratio * (a - later)
        return [self._periodogram(covariance, window) for covariance, window in zip(parts, self.windows, strict=True)]

    def expected_sum(self, parts: Sequence[Part]) -> list[Tensor]:
        """Those of several parts and of the noise."""
        total = [
            torch.zeros_like(window[..., :1]) + window[..., :1] * sigma**2
            for window, sigma in zip(
                self.windows, (self.data.total_sigma, self.data.difference_sigma, 0.0), strict=True
            )
        ]
        for part in parts:
            total = [a + b for a, b in zip(total, self.expected(part), strict=True)]
        return total

    def log_likelihood(self, expected: Sequence[Tensor]) -> Float[Tensor, "*candidates"]:
        """Logarithm of the likelihood, up to a constant."""
        s_m, s_d, s_x = expected[0].real, expected[1].real, expected[2]
        i_m, i_d, i_x = self.periodograms[0].real, self.periodograms[1].real, self.periodograms[2]
        determinant = s_m * s_d - s_x.abs().square()
        fit = (s_d * i_m + s_m * i_d - 2 * (s_x * i_x.conj()).real) / determinant
        return -_TAPERED * (determinant.log() + fit).sum((-1, -2))

    def log_prior(self, part: Part, free: Float[Tensor, "2"]) -> Float[Tensor, "*candidates"]:
        """Logarithm of a wide prior density of the numbers of a part, so that none runs away that the data leave open.

        Args:
            free: one for a process that is looked for. That one of nothing is unlikely is no evidence.
        """
        rms = self.data.total.square().mean().sqrt().clamp(min=self.data.total_sigma)
        total = -(free * ((part.sigma / rms).log() / _USUAL_SPREAD).square()).sum(-1) / 2
        if part.kind == "broad":
            return total - ((part.span / (self.samples / 32)).log() / _LENGTH_SPREAD).square().sum(-1) / 2
        return total - ((part.span[..., 1] / self.samples).log() / _USUAL_SPREAD).square() / 2

    def missing_waves(self, parts: Sequence[Part]) -> list[Part]:
        """Waves that may be missing: where the periodogram of m exceeds its expectation most, and beside the others.

        Two waves closer than the taper separates look like one in the periodogram, but are wider.
        """
        power, expected = self.periodograms[0].real.mean(0), self.expected_sum(parts)[0].real.mean(0)
        cycles = [int((power / expected).argmax()) + float(_FIRST_WAVE)]
        for part in parts:
            if part.kind == "wave":
                cycles += [self.samples / float(part.span[0]) + side for side in (-_BESIDE, _BESIDE)]
        return [self._wave(power, cycle) for cycle in cycles if _FIRST_WAVE <= cycle < len(power)]

    def _wave(self, power: Tensor, cycles: float) -> Part:
        """A wave of some cycles in all, as large as the periodogram shows."""
        sigma = (2 * power[round(cycles) - _FIRST_WAVE] / self.samples).sqrt()
        span = power.new_tensor([self.samples / cycles, float(self.samples)])
        return Part("wave", torch.stack([sigma, sigma]), span)

    def _periodogram(self, covariance: Tensor, window: Tensor) -> Tensor:
        whole = covariance[..., None, :] * window
        size = self.samples
        return torch.fft.rfft(whole[..., :size] + whole[..., size:])[..., _FIRST_WAVE:]
