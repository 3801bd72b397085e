"""Values of an image at fractional columns of its lines."""

from dataclasses import dataclass

import cv2
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from lsvision.image.stereo.differences import second_difference


@dataclass(frozen=True)
class CubicLines:
    """Lines of an image, which Catmull-Rom interpolation reads anywhere between their columns.

    A cubic between two columns is the straight line less ``t (1 - t) / 2`` times the second differences between them,
    t from 0 to 1. Both are linear interpolations, which OpenCV does at once: the formula of four neighbours takes 2.3
    times as long.
    """

    values: Float[Tensor, "lines image_width"]
    curvature: Float[Tensor, "lines image_width"]

    @classmethod
    def of(cls, image: Float[Tensor, "lines image_width"]) -> "CubicLines":
        """Those of an image, float32."""
        return cls(image, second_difference(image))

    def at(self, disparity: Float[Tensor, "lines width"], first_column: int = 0) -> Float[Tensor, "lines width"]:
        """Values at ``u - disparity``, u from ``first_column`` on; positions are clamped to the image less a pixel."""
        stop = first_column + disparity.shape[1]
        column = torch.arange(first_column, stop, dtype=torch.float32).sub(disparity)
        column.clamp_(1.0, self.values.shape[1] - 2.0)
        line = _lines_of(column).numpy()
        straight, bend = (
            torch.from_numpy(cv2.remap(part.numpy(), column.numpy(), line, cv2.INTER_LINEAR))
            for part in (self.values, self.curvature)
        )
        t = column.frac_()
        return straight.addcmul_(bend.mul_(t), t.sub(1.0), value=0.5)


def warp_cubic(
    image: Float[Tensor, "lines image_width"], disparity: Float[Tensor, "lines width"], first_column: int = 0
) -> Float[Tensor, "lines width"]:
    """Values of an image at ``u - disparity``, u from ``first_column`` on, as ``CubicLines.at``."""
    return CubicLines.of(image).at(disparity, first_column)


def warp_linear(
    image: Shaped[Tensor, "lines image_width"], column: Float[Tensor, "lines width"]
) -> Shaped[Tensor, "lines width"]:
    """Values of an image at columns of each line by linear interpolation; beyond the image those of its edge."""
    line = _lines_of(column).numpy()
    values = cv2.remap(image.numpy(), column.numpy(), line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(values)


def _lines_of(column: Float[Tensor, "lines width"]) -> Float[Tensor, "lines width"]:
    """The line of each position."""
    return torch.arange(column.shape[0], dtype=torch.float32)[:, None].expand_as(column).contiguous()
