"""Sub-pixel position of checkerboard corners: a parametric fit of the blurred saddle by Levenberg-Marquardt."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.levenberg_marquardt import (
    Linearisation,
    NormalMatrix,
    Windows,
    fit_parameters,
    pixel_grid,
)
from lsvision.image.board.residuals import Residuals
from lsvision.image.board.saddle_model import (
    FULL,
    PARAMETERS,
    PIXEL_VARIANCE,
    PLAIN,
    POSITION,
    Saddle,
    SaddleParameters,
)

_TOGETHER = 2**19  # values of a Jacobian that stay in the processor's cache
# The corner of the plain saddle only starts the full one, whose corner is measured.
_PLAIN_STEP_PX, _FULL_STEP_PX = 3e-2, 2e-4
_SMALLEST_CROSSING = 0.2  # sine of the angle between edges: nearly parallel ones cross in no corner


@dataclass(frozen=True)
class SaddleFit:
    """Fitted corners: ``position (corners, 2)`` as (u, v) px from the window's centre, and whether each is a corner.

    ``misfit`` is the window less the fitted saddle, 0 at pixels that are not fitted. ``covariance``, px², is that of
    independent noise in the pixels; where it is correlated, as a surface's texture is,
    ``correlated_noise.corner_covariance`` finds the covariance from the ``residuals`` of a board's fits.
    """

    position: Float[Tensor, "corners 2"]
    covariance: Float[Tensor, "corners 2 2"]
    residuals: Residuals
    parameters: SaddleParameters
    misfit: Float[Tensor, "corners pixels"]
    blur_px: Float[Tensor, " corners"]
    contrast: Float[Tensor, " corners"]
    residual: Float[Tensor, " corners"]
    valid: Bool[Tensor, " corners"]

    @property
    def grid(self) -> Float[Tensor, "2 pixels"]:
        """(u, v) of the pixels of the windows from their centres, px."""
        return pixel_grid(self.residuals.size, self.misfit)

    def saddles(self, corners: Bool[Tensor, " corners"]) -> Saddle:
        """The fitted saddles of some corners."""
        return Saddle.on_grid(SaddleParameters(self.parameters.columns[corners]), self.grid)


@dataclass(frozen=True)
class SaddleOptions:
    """How far a fit goes, and which fits are corners.

    Args:
        plain: fit one level and gradient to the whole window and stop: good to a few hundredths of a pixel.
        iterations: largest number of steps of the plain and of the full model.
        max_shift_px: a corner further than this from the centre is not valid.
        max_residual: a corner whose residual rms exceeds this share of its contrast is not valid.
    """

    plain: bool = False
    iterations: int = 12
    max_shift_px: float = 3.0
    max_residual: float = 0.35


def fit_saddles(
    windows: Float[Tensor, "corners size size"],
    angles: Float[Tensor, "corners 2"],
    mask: Bool[Tensor, "corners size size"] | None = None,
    options: SaddleOptions | None = None,
) -> SaddleFit:
    """Fit the model of ``saddle_model`` to windows centred near checkerboard corners: 17 parameters for each window.

    The covariance is the residual variance times the inverse normal matrix.

    Args:
        windows: grey values, odd size; the corner within about two pixels of the centre. One with a NaN is not valid.
        angles: direction of the normal of each edge, rad from u towards v; good to about 0.3 rad.
        mask: pixels to fit, all where None: those of the four squares around the corner, say.
    """
    if mask is None:
        mask = torch.ones_like(windows, dtype=torch.bool)
    options = options or SaddleOptions()
    count = max(1, round(PARAMETERS * windows.numel() / _TOGETHER))
    parts = zip(*(each.tensor_split(count) for each in (windows, angles, mask)), strict=True)
    fits = [_fit_together(Windows.of_pixels(pixels, inside), turned, options) for pixels, turned, inside in parts]
    return _joined(SaddleFit, fits)


def _joined(kind: type, parts: Sequence[Any]) -> Any:
    """Fits of several parts as one, field by field."""
    values = ([getattr(part, item.name) for part in parts] for item in fields(kind))
    return kind(*(torch.cat(v) if isinstance(v[0], Tensor) else _joined(type(v[0]), v) for v in values))


def _fit_together(windows: Windows, angles: Tensor, options: SaddleOptions) -> SaddleFit:
    # The plain saddle has few minima; the full one then starts inside the right one of its many.
    plain = fit_parameters(windows, _start(windows, angles), PLAIN, _PLAIN_STEP_PX, options.iterations)
    if options.plain:
        fitted = Linearisation.of(windows, plain.parameters, FULL)
    else:
        fitted = fit_parameters(windows, plain.parameters, FULL, _FULL_STEP_PX, options.iterations)
    parameters = fitted.parameters
    variance = fitted.cost / (windows.weight.sum(-1) - PARAMETERS).clamp(min=1)
    inverse_normal = NormalMatrix.of(fitted.jacobian).inverse()
    influence = inverse_normal[:, POSITION] @ fitted.jacobian
    residuals = Residuals(fitted.residual, windows.weight, fitted.jacobian, influence, parameters.position)
    return SaddleFit(
        position=parameters.position,
        covariance=inverse_normal[:, POSITION, POSITION] * variance[:, None, None],
        residuals=residuals if options.plain else _without_other_shapes(windows, parameters, residuals),
        parameters=parameters,
        misfit=fitted.residual,
        blur_px=(parameters.blur.square() + PIXEL_VARIANCE).sqrt(),
        contrast=parameters.contrast.abs(),
        residual=variance.sqrt(),
        valid=windows.complete & _is_corner(parameters, variance.sqrt(), windows, options),
    )


def _without_other_shapes(windows: Windows, parameters: SaddleParameters, fitted: Residuals) -> Residuals:
    """Residuals less the differences of real pictures from the model, which are no noise.

    They are not fitted with the corner: in sharp windows that would let noise move it further.
    """
    shapes = Saddle.on_grid(parameters, windows.grid).other_shapes() * windows.weight[:, None]
    jacobian = torch.cat([fitted.jacobian, shapes], dim=1)
    amount = NormalMatrix.of(jacobian).inverse() @ (jacobian @ fitted.residual[..., None])
    residual = fitted.residual - (jacobian.mT @ amount)[..., 0]
    return replace(fitted, residual=residual, jacobian=jacobian)


def _start(windows: Windows, angles: Tensor) -> SaddleParameters:
    """Corner at the centre, blur of one pixel, contrast by projection on that pattern (its sign matters)."""
    zero, one = torch.zeros_like(windows.values[:, 0]), torch.ones_like(windows.values[:, 0])
    pattern = Saddle.on_grid(SaddleParameters.at_centre(angles, zero, one), windows.grid).values() * windows.weight
    pixels = windows.weight.sum(-1)
    mean, middle = windows.values.sum(-1) / pixels, pattern.sum(-1) / pixels
    centred = pattern - middle[:, None] * windows.weight
    contrast = (centred * windows.values).sum(-1) / centred.square().sum(-1)
    return SaddleParameters.at_centre(angles, mean - contrast * middle, contrast)


def _is_corner(parameters: SaddleParameters, residual: Tensor, windows: Windows, options: SaddleOptions) -> Tensor:
    first, second = parameters.angles.unbind(-1)
    return (
        (torch.linalg.vector_norm(parameters.position, dim=-1) < options.max_shift_px)
        & (residual < options.max_residual * parameters.contrast.abs())
        & (torch.sin(first - second).abs() > _SMALLEST_CROSSING)
        & (parameters.blur < windows.grid.amax() / 2)
    )
