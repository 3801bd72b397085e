"""What was measured of a camera's response."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import Camera
from lsvision.types import CameraResponse

_WHITE_QUANTILE = 0.98  # of the gains of all columns: the light of those that are as bright is left as it is


@dataclass(frozen=True)
class MeasuredResponse:
    """Offset and gain of the columns of a camera, ``(width, channels)``, with their standard deviations.

    Attributes:
        offset: codes. gain: codes over the dark for one white, until ``evened``; NaN where a column does not see.
        noise: standard deviation of the samples of the dark and of the white reference, codes.
        lines: number of lines of the references that were used, dark and white.
    """

    offset: Float[Tensor, "width channels"]
    offset_sigma: Float[Tensor, "width channels"]
    gain: Float[Tensor, "width channels"]
    gain_sigma: Float[Tensor, "width channels"]
    noise: tuple[float, float]
    lines: tuple[int, int]

    @property
    def response(self) -> CameraResponse:
        """What makes images even."""
        return CameraResponse(self.offset.float(), self.gain.float())

    @property
    def relative_sigma(self) -> float:
        """The usual standard deviation of a gain, relative."""
        return float((self.gain_sigma / self.gain).nanmedian())

    @property
    def blind_columns(self) -> int:
        """How many columns do not see in some colour."""
        return int(torch.isnan(self.gain).any(-1).sum())

    def over(self, white: float) -> "MeasuredResponse":
        """The same with gains relative to those of columns that deliver ``white`` codes."""
        return MeasuredResponse(
            self.offset, self.offset_sigma, self.gain / white, self.gain_sigma / white, self.noise, self.lines
        )


def evened(measured: Mapping[Camera, MeasuredResponse]) -> dict[Camera, MeasuredResponse]:
    """Gains of all cameras relative to the brightest columns of all: white then is one code in all columns and colours.

    Gains are at most about 1, so that no code of an even image exceeds those of the cameras by much.
    """
    gains = torch.cat([item.gain.flatten() for item in measured.values()])
    white = float(gains[~gains.isnan()].quantile(_WHITE_QUANTILE))
    return {camera: item.over(white) for camera, item in measured.items()}
