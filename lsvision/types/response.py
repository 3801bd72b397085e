"""What a line camera makes of light, column by column."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor


@dataclass(frozen=True)
class CameraResponse:
    """Offset and gain of every column and colour of a line camera: value = (raw - offset) / gain.

    Attributes:
        offset: codes of the raw image that a column delivers without light, float32.
        gain: codes per code of the even camera, > 0, float32; NaN where a column does not see.
    """

    offset: Float[Tensor, "width channels"]
    gain: Float[Tensor, "width channels"]

    @property
    def shape(self) -> tuple[int, int]:
        """(width, channels)."""
        width, channels = self.gain.shape
        return width, channels

    @property
    def blind(self) -> Bool[Tensor, " width"]:
        """Columns that do not see in some colour."""
        return torch.isnan(self.gain).any(-1)

    def values(self, raw: Shaped[Tensor, "*lines width channels"]) -> Float[Tensor, "*lines width channels"]:
        """What an even camera would have delivered for raw codes, float32; 0 where a column does not see."""
        inverse = self.gain.reciprocal().nan_to_num_(0.0)
        return raw.to(torch.float32).sub_(self.offset).mul_(inverse)
