"""Images of a camera whose columns respond unevenly, made even where they are read, by line ranges."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lsvision.image.brightness import white_level
from lsvision.image.levels import CameraLevels
from lsvision.types import CameraResponse, LineImage, missing_ranges


@dataclass(frozen=True)
class FlatFieldImage:
    """A ``LineImage`` of what an even camera would have delivered: (raw - offset) / gain, in the source's dtype.

    A sample that is saturated in the source is no darker than there: in images of bytes it stays 255. What its values
    mean is asked of ``source``, since the largest code of an even image is not where the camera saturates.
    """

    source: LineImage
    response: CameraResponse

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, channels)."""
        return self.source.shape

    @property
    def dtype(self) -> torch.dtype:
        """That of the source."""
        return self.source.dtype

    @property
    def missing(self) -> tuple[range, ...]:
        """Lines that the source lacks."""
        return missing_ranges(self.source)

    def read(self, start: int, stop: int) -> Tensor:
        """Lines ``start..stop-1``, rounded to whole codes and clamped to the range of the dtype."""
        raw = self.source.read(start, stop)
        values = self.response.values(raw)
        saturated = self._levels.saturated(raw)
        if saturated is not None:
            values = torch.where(saturated, values.maximum(raw.to(torch.float32)), values)
        top = float(np.iinfo(raw.numpy().dtype).max)
        return values.round_().clamp_(0.0, top).to(raw.dtype)

    def values(self, raw: Shaped[Tensor, "lines width channels"]) -> Float[Tensor, "lines width channels"]:
        """What an even camera would have delivered for some lines of the source, neither rounded nor clamped."""
        return self.response.values(raw)

    @cached_property
    def blind(self) -> Bool[Tensor, " width"] | None:
        """Columns that do not see; None where all do."""
        blind = self.response.blind
        return blind if bool(blind.any()) else None

    @cached_property
    def _levels(self) -> CameraLevels:
        return CameraLevels.of(self.source, white_level(self.source))
