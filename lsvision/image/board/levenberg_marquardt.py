"""Levenberg-Marquardt fits of saddles to windows of pixels, all windows at once, each with its own damping.

The Jacobian is in closed form: the general method of ``estimation.least_squares``, which differentiates forward, takes
thirty times as long on the 88 windows of a board.
Source: Marquardt 1963.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.saddle_model import BLUR, POSITION, Saddle, SaddleModel, SaddleParameters

_FIRST_DAMPING = 1e-3
_DAMPING_RANGE = 1e-9, 1e6
_SMALLEST_PIVOT = 1e-6  # of the Cholesky factor of a matrix with ones on its diagonal
_BLUR_RANGE_PX = 0.1, 20.0  # a pixel averages over more than a tenth of a pixel: sharper edges look the same


@dataclass(frozen=True)
class Windows:
    """Square windows around corners, one row of pixels each; values are 0 where the weight is.

    ``weight`` is 1 at the pixels to fit, 0 elsewhere; ``grid`` is (u, v) of the pixels from the centre, px. A window
    that is not ``complete`` had missing pixels: its values are 0.
    """

    values: Float[Tensor, "corners pixels"]
    weight: Float[Tensor, "corners pixels"]
    grid: Float[Tensor, "2 pixels"]
    complete: Bool[Tensor, " corners"]

    @classmethod
    def of_pixels(
        cls, pixels: Float[Tensor, "corners size size"], mask: Bool[Tensor, "corners size size"]
    ) -> "Windows":
        """Windows of odd size, of which the mask's pixels are fitted."""
        grid = pixel_grid(pixels.shape[-1], pixels)
        complete = torch.isfinite(pixels).flatten(1).all(-1)
        weight = mask.to(pixels.dtype).flatten(1)
        values = torch.where(complete[:, None], pixels.flatten(1), 0.0) * weight
        return cls(values, weight, grid, complete)


def pixel_grid(size: int, like: Tensor) -> Float[Tensor, "2 pixels"]:
    """(u, v) of the pixels of a square window from its centre, px."""
    axis = torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2
    return torch.stack(torch.meshgrid(axis, axis, indexing="xy")).flatten(1)


@dataclass(frozen=True)
class Linearisation:
    """Saddles at some parameters, compared with their windows: weighted residual, Jacobian, sum of squares."""

    columns: Float[Tensor, "corners 17"]
    residual: Float[Tensor, "corners pixels"]
    jacobian: Float[Tensor, "corners free pixels"]
    cost: Float[Tensor, " corners"]

    @classmethod
    def of(cls, windows: Windows, parameters: SaddleParameters, model: SaddleModel) -> "Linearisation":
        """Compare saddles with windows, and differentiate them by the free parameters of a model."""
        saddle = Saddle.on_grid(parameters, windows.grid)
        residual = windows.values - saddle.values() * windows.weight
        jacobian = saddle.jacobian(model, windows.weight)
        return cls(parameters.columns, residual, jacobian, residual.square().sum(-1))

    @property
    def parameters(self) -> SaddleParameters:
        """Of the saddles."""
        return SaddleParameters(self.columns)

    def improved_by(self, trial: "Linearisation", better: Bool[Tensor, " corners"]) -> "Linearisation":
        """The trial where it is better, this elsewhere; no copy where all are better."""
        if bool(better.all()):
            return trial
        pairs = ((getattr(trial, item.name), getattr(self, item.name)) for item in fields(self))
        return Linearisation(*(torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in pairs))


@dataclass(frozen=True)
class NormalMatrix:
    """``J Jᵀ`` of Jacobians whose rows are scaled to unit length: the unit of the grey values does not matter."""

    scaled: Float[Tensor, "corners parameters parameters"]
    length: Float[Tensor, "corners parameters"]

    @classmethod
    def of(cls, jacobian: Float[Tensor, "corners parameters pixels"]) -> "NormalMatrix":
        """Normal matrices of Jacobians."""
        normal = jacobian @ jacobian.mT
        length = normal.diagonal(dim1=-2, dim2=-1).sqrt()
        length = torch.where(length > 0, length, 1.0)  # without contrast nothing moves the corner
        return cls(normal / (length[:, None] * length[..., None]), length)

    def without(self, parameter: int, corners: Bool[Tensor, " corners"]) -> "NormalMatrix":
        """As if a parameter of some corners changed nothing."""
        scaled, length = self.scaled.clone(), self.length.clone()
        scaled[corners, parameter] = 0
        scaled[corners, :, parameter] = 0
        scaled[corners, parameter, parameter] = 1
        length[corners, parameter] = torch.inf
        return NormalMatrix(scaled, length)

    def damped_solution(self, gradient: Tensor, damping: Tensor) -> Tensor:
        """Steps (corners, parameters): solutions of ``(J Jᵀ + damping D²) step = gradient``, D the rows' lengths."""
        damped = self.scaled.clone()
        damped.diagonal(dim1=-2, dim2=-1).add_(damping[:, None])
        return torch.linalg.solve(damped, gradient / self.length) / self.length

    def inverse(self) -> Tensor:
        """``(J Jᵀ)⁻¹``, in the unit of the parameters; the pseudo-inverse of what is about singular."""
        # A tenth of the time of pseudo-inverses of all.
        root, _ = torch.linalg.cholesky_ex(self.scaled)
        singular = ~(root.diagonal(dim1=-2, dim2=-1).amin(-1) > _SMALLEST_PIVOT)
        inverse = torch.empty_like(root)
        inverse[~singular] = torch.cholesky_inverse(root[~singular])
        inverse[singular] = torch.linalg.pinv(self.scaled[singular], hermitian=True)
        return inverse / (self.length[:, None] * self.length[..., None])


def fit_parameters(
    windows: Windows, start: SaddleParameters, model: SaddleModel, smallest_step_px: float, iterations: int
) -> Linearisation:
    """Minimise each window's sum of squared residuals over the free parameters of a model.

    Args:
        smallest_step_px: a window whose corner moves by no more than this is finished.
        iterations: largest number of steps.

    Returns:
        The saddles found, compared with their windows.
    """
    current = Linearisation.of(windows, start, model)
    damping = torch.full_like(current.cost, _FIRST_DAMPING)
    moving = torch.ones_like(damping, dtype=torch.bool)
    for _ in range(iterations):
        step = _damped_step(current, model, damping)
        trial = Linearisation.of(windows, _bounded(current.columns + step), model)
        better = moving & (trial.cost < current.cost)
        current = current.improved_by(trial, better)
        damping = torch.where(better, damping / 10, damping * 5).clamp(*_DAMPING_RANGE)
        moving = moving & (torch.linalg.vector_norm(step[:, POSITION], dim=-1) > smallest_step_px)
        if not bool(moving.any()):
            break
    return current


def _damped_step(current: Linearisation, model: SaddleModel, damping: Tensor) -> Tensor:
    """Step (corners, 17), 0 in the parameters that are not free.

    A blur at the end of its range that would leave it stays: the other parameters go where they fit best with it.
    """
    gradient = (current.jacobian @ current.residual[..., None])[..., 0]
    normal = NormalMatrix.of(current.jacobian)
    step = torch.zeros_like(current.columns)
    step[:, model.free] = normal.damped_solution(gradient, damping)
    smallest, largest = _BLUR_RANGE_PX
    blur, change = current.columns[:, BLUR], step[:, BLUR]
    held = ((blur <= smallest) & (change < 0)) | ((blur >= largest) & (change > 0))
    if bool(held.any()):
        step[:, model.free] = normal.without(BLUR, held).damped_solution(gradient, damping)
    return step


def _bounded(columns: Tensor) -> SaddleParameters:
    parameters = SaddleParameters(columns.clone())
    parameters.blur.clamp_(*_BLUR_RANGE_PX)
    return parameters
