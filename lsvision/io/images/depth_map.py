"""A depth map from elsewhere: what the rig cannot have seen was not measured, and another unit is an error."""

from contextlib import suppress
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.errors import FileFormatError
from lsvision.types import LineImage, missing_ranges

# Times the depth of zero disparity. Whatever lies beyond is a code for "no data", an infinity or a fault of the sensor.
_NEAREST, _FARTHEST = 0.2, 5.0

_SAMPLED_LINES = 5
_PLAUSIBLE_SHARE = 0.01  # of the sampled values; fewer are chance
# A map in another unit still is of the rig's object, whose depth varies little.
_SAME_OBJECT = 1.5
_UNITS = {1e-3: "metres", 1e-1: "centimetres", 10.0: "tenths of a millimetre", 1e3: "micrometres"}


@dataclass(frozen=True)
class PlausibleDepth:
    """A depth map of one float channel, mm, that is NaN where the stored one is not what a rig can see.

    ``expected_mm`` is the rig's depth of zero disparity.
    """

    stored: LineImage
    expected_mm: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        return self.stored.shape

    @property
    def dtype(self) -> torch.dtype:
        """That of the stored map."""
        return self.stored.dtype

    @property
    def missing(self) -> tuple[range, ...]:
        """Lines of the stored map that are not there."""
        return missing_ranges(self.stored)

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1`` as a tensor ``(stop - start, width, 1)``."""
        z = self.stored.read(start, stop)
        return torch.where(self._is_plausible(z), z, torch.nan)

    def unit_problem(self) -> str | None:
        """What is wrong with the map's unit, judged by a few lines; None where they hold depths, or nothing at all."""
        z = self._sampled()
        z = z[torch.isfinite(z) & (z != 0)]
        if z.numel() == 0 or self._is_plausible(z).double().mean() >= _PLAUSIBLE_SHARE:
            return None
        positive, negative = z[z > 0], z[z < 0].unique()
        signed = len(negative) > 1  # a single negative value is a code for "no data", several are measurements
        if positive.numel() == 0 and not signed:
            return None
        typical = float((z if signed else positive).median())
        guess = "heights" if signed else self._unit_of(positive)
        looks = f"these look like {guess}" if guess else "these are no depths of this rig"
        return f"median {typical:.3g} where the rig sees {self.expected_mm:.0f} mm: expected depth in mm, {looks}"

    def _sampled(self) -> Float[Tensor, " values"]:
        """Values of a few lines; one that cannot be decoded says nothing here, and is an error where it is read."""
        lines = self.shape[0]
        sampled = [torch.empty(0)]
        for line in sorted({(2 * i + 1) * lines // (2 * _SAMPLED_LINES) for i in range(_SAMPLED_LINES)}):
            with suppress(FileFormatError):
                sampled.append(self.stored.read(line, line + 1).flatten())
        return torch.cat(sampled)

    def _unit_of(self, positive: Float[Tensor, " values"]) -> str | None:
        """The unit in which positive values are depths of the rig; "heights" where they are small and in none."""
        ratio = float(positive.median()) / self.expected_mm
        for factor, name in _UNITS.items():
            if 1 / _SAME_OBJECT < ratio / factor < _SAME_OBJECT:
                return name
        return "heights" if ratio < _NEAREST else None

    def _is_plausible(self, z: Tensor) -> Tensor:
        return (z >= _NEAREST * self.expected_mm) & (z <= _FARTHEST * self.expected_mm)
