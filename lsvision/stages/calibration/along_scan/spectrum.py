"""What errors along the scan are made of: processes of all ``kernels``, and waves that never lose their phase.

A machine vibrates at its own frequencies. Over a scan such a wave is a sine: of two unknowns per scan and component,
however short a piece of it is seen. A kernel that forgets its phase after some lengths takes it for many, and what it
leaves open is n. The frequency of a wave is free, and the same in all scans and components.

Source: Solin & Särkkä 2014, Explicit Link Between Periodic Covariance Functions and State Space Models; the resonator
without damping.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.stages.calibration.along_scan.kernels import Knots, covariance_of

MOST_WAVES = 8


@dataclass(frozen=True)
class Spectrum:
    """Variances, mm², of the kernels and waves of each component; ``frequency`` is in waves per unit of travel."""

    variances: Float[Tensor, "*batch 4 kernels"]
    frequency: Float[Tensor, "*batch waves"]
    of_waves: Float[Tensor, "*batch 4 waves"]

    @classmethod
    def of_kernels(cls, variances: Float[Tensor, "*batch 4 kernels"]) -> "Spectrum":
        """One without waves."""
        return cls(variances, variances[..., 0, :0], variances[..., :0])

    @property
    def waves(self) -> int:
        """Number of waves."""
        return self.frequency.shape[-1]

    @property
    def total(self) -> Float[Tensor, "*batch 4"]:
        """Variance of each component, mm²."""
        return self.variances.sum(-1) + self.of_waves.sum(-1)

    def covariance(self, knots: Knots) -> Float[Tensor, "*batch 4 knots knots"]:
        """Covariance of the errors of each component at knots, mm²."""
        waves = torch.einsum("...cw,...wij->...cij", self.of_waves, wave_correlations(self.frequency, knots))
        return covariance_of(self.variances, knots) + waves

    def at(self, place: tuple[int, ...]) -> "Spectrum":
        """That of one problem of a batch."""
        return Spectrum(self.variances[place], self.frequency[place], self.of_waves[place])

    def set(self, place: tuple[int, ...], one: "Spectrum") -> None:
        """Make ``one`` that of a problem of the batch, in place."""
        self.variances[place][..., : one.variances.shape[-1]] = one.variances
        self.frequency[place][: one.waves] = one.frequency
        self.of_waves[place][..., : one.waves] = one.of_waves

    def padded(self) -> "Spectrum":
        """The same with as many waves as one can have at most, the further ones of no variance."""
        more = (0, MOST_WAVES - self.waves)
        return Spectrum(self.variances, pad(self.frequency, more), pad(self.of_waves, more))


def wave_correlations(
    frequency: Float[Tensor, "*batch waves"], knots: Knots
) -> Float[Tensor, "*batch waves knots knots"]:
    """Correlation between knots of waves of any phase."""
    return torch.cos(frequency[..., None, None] * _angle(frequency, knots))


def wave_slopes(frequency: Float[Tensor, "*batch waves"], knots: Knots) -> Float[Tensor, "*batch waves knots knots"]:
    """Derivative of the correlation by the frequency."""
    angle = _angle(frequency, knots)
    return -angle * torch.sin(frequency[..., None, None] * angle)


def _angle(like: Tensor, knots: Knots) -> Float[Tensor, "knots knots"]:
    place = knots.place(like)
    return 2.0 * math.pi * (place[:, None] - place)
