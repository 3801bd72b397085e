"""What fits of corners have left of their windows, and how their corners follow from the pixels."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.board.levenberg_marquardt import NormalMatrix


@dataclass(frozen=True)
class Residuals:
    """What fits have left of square windows, ``pixels = size²``, and how their corners follow from the pixels.

    The residual is orthogonal to the ``jacobian``, the derivative of the window by the parameters, of which the first
    two are the corner; all are 0 at pixels that are not fitted, where the ``weight`` is 0. ``influence`` is the shift
    of the corner by the noise of each pixel, ``corner`` is (u, v) from the middle of the window, px.
    """

    residual: Float[Tensor, "fits pixels"]
    weight: Float[Tensor, "fits pixels"]
    jacobian: Float[Tensor, "fits parameters pixels"]
    influence: Float[Tensor, "fits 2 pixels"]
    corner: Float[Tensor, "fits 2"]

    @property
    def size(self) -> int:
        """Pixels across a window."""
        return math.isqrt(self.residual.shape[-1])

    @property
    def steepness(self) -> Float[Tensor, "fits pixels"]:
        """Gradient of the window, of rms 1: large on the edges of the squares."""
        gradient = self.jacobian[:, :2].square().sum(1)
        return (gradient / gradient.mean(-1, keepdim=True).clamp(min=torch.finfo(gradient.dtype).tiny)).sqrt()

    def basis(self) -> Float[Tensor, "fits parameters pixels"]:
        """Orthonormal rows that span the Jacobian's."""
        return torch.linalg.qr(self.jacobian.mT).Q.mT

    def of(self, fits: Tensor | slice) -> "Residuals":
        """Some of the fits."""
        if isinstance(fits, Tensor) and fits.dtype == torch.bool and bool(fits.all()):
            return self  # a copy of the Jacobians takes longer than much of what follows
        return Residuals(
            self.residual[fits], self.weight[fits], self.jacobian[fits], self.influence[fits], self.corner[fits]
        )

    def without(self, difference: Float[Tensor, "fits pixels"]) -> "Residuals":
        """What fits would have left of windows without a difference from the model."""
        amount = NormalMatrix.of(self.jacobian).inverse() @ (self.jacobian @ difference[..., None])
        left = difference - (self.jacobian.mT @ amount)[..., 0]
        return replace(self, residual=self.residual - left)

    def cropped(self, size: int) -> "Residuals":
        """The middle of the windows."""
        rim = (self.size - size) // 2
        inner = torch.arange(self.size**2).reshape(self.size, self.size)[rim : rim + size, rim : rim + size].flatten()
        return Residuals(
            self.residual[:, inner],
            self.weight[:, inner],
            self.jacobian[..., inner],
            self.influence[..., inner],
            self.corner,
        )
