"""The kinds of noise in the windows around a board's corners, and their covariances.

White noise, noise with Gaussian correlations of one to a few pixels, shifts of whole lines, sideways and along the
scan, and white noise on the edges of the squares.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.image.board.residuals import Residuals

_SCALES_PX = (1.0, 2.0, 4.0)  # of the correlations of neighbouring pixels
SHIFTS = slice(1 + len(_SCALES_PX), 3 + len(_SCALES_PX))
"""The kinds that shift lines, sideways and along the scan."""


@dataclass(frozen=True)
class Correlation:
    """Covariances of the pixels of one window with those of another, for each kind of noise of unit strength.

    Each is a product along the lines and across them, times the amplitude of the noise in either pixel. Within an image
    the products are the same for all fits, and ``places`` is 1; it is the number of fits between two images.
    """

    along_v: Float[Tensor, "kinds places size size"]
    along_u: Float[Tensor, "kinds places size size"]
    first: Float[Tensor, "kinds fits pixels"]
    second: Float[Tensor, "kinds fits pixels"]

    @classmethod
    def between(cls, first: Residuals, second: Residuals, dtype: torch.dtype) -> "Correlation":
        """Of windows of the same size around the same corners."""
        index = torch.arange(first.size, dtype=dtype)
        shift = (first.corner[:1] * 0 if first is second else second.corner - first.corner).to(dtype)
        lag = index[:, None] - index + shift.mT[..., None, None]  # u and v, fits, size, size
        box, wide = (1 - lag.abs()).clamp(min=0), [_bell(lag / scale) for scale in _SCALES_PX]
        # All pixels of a line are shifted alike, those of the next by another amount.
        along_u = torch.stack([box[0], *(bell[0] for bell in wide), *[torch.ones_like(box[0])] * 2, box[0]])
        along_v = torch.stack([box[1], *(bell[1] for bell in wide), *[box[1]] * 3])
        return cls(along_v, along_u, *(_amplitudes(fits).to(dtype) for fits in (first, second)))

    def times(self, images: Float[Tensor, "fits rows pixels"]) -> Float[Tensor, "kinds fits rows pixels"]:
        """Each applied to images in the second window: images in the first."""
        kinds, places, size, _ = self.along_u.shape
        scaled = images * self.second[:, :, None]
        # All lines of a place in one product with the columns, then all columns in one with the lines.
        by_u = (scaled.reshape(kinds, places, -1, size) @ self.along_u.mT).reshape(*scaled.shape[:3], size, size)
        by_v = (by_u.mT.reshape(kinds, places, -1, size) @ self.along_v.mT).reshape(by_u.shape)
        return by_v.mT.flatten(-2) * self.first[:, :, None]

    def transposed(self) -> "Correlation":
        """Of the second window with the first."""
        return Correlation(self.along_v.mT, self.along_u.mT, self.second, self.first)

    def products(self) -> list["Correlation"]:
        """Each kind times all, pixel by pixel."""
        parts = (self.along_v, self.along_u, self.first, self.second)
        return [Correlation(*(part * part[kind] for part in parts)) for kind in range(len(self.first))]

    def of(self, fits: slice) -> "Correlation":
        """Some of the fits."""
        places = slice(None) if self.along_u.shape[1] == 1 else fits
        return Correlation(self.along_v[:, places], self.along_u[:, places], self.first[:, fits], self.second[:, fits])


def _amplitudes(fits: Residuals) -> Float[Tensor, "kinds fits pixels"]:
    """Of each kind of noise in each pixel. A line that is shifted by one pixel changes by its gradient."""
    even = torch.ones_like(fits.residual)
    by_shift = fits.jacobian[:, :2].unbind(1)
    return torch.stack([*[even] * (1 + len(_SCALES_PX)), *by_shift, fits.steepness])


def _bell(x: Tensor) -> Tensor:
    """``exp(-x²/2)``, 0 where that is nothing beside 1: products with denormal numbers take ten times as long."""
    bell = torch.exp(-0.5 * x.square())
    return torch.where(bell > torch.finfo(x.dtype).eps ** 2, bell, 0.0)
