"""Sub-pixel position of checkerboard corners: a parametric fit of the blurred saddle, all windows at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.correlated_noise import correlation_gain

# Columns of the parameter vector: five that enter non-linearly, then (1, u, v) of each of the four levels.
_POSITION, _ANGLE_1, _ANGLE_2, _BLUR, _LEVELS = slice(0, 2), 2, 3, 4, 5
_PARAMETERS = 17
_OFFSET, _CONTRAST = 5, 14
_TOGETHER = 2**18  # values of a Jacobian that stay in the processor's cache
# The plain saddle b + g (u, v) + c E1 E2 comes first: it has few minima, the full model then starts inside its own.
_PLAIN = [0, 1, _ANGLE_1, _ANGLE_2, _BLUR, 5, 6, 7, _CONTRAST]
_FULL = list(range(_PARAMETERS))
# A corner stands still where steps are shorter: the plain saddle's only starts the full one, whose is measured.
_PLAIN_STEP_PX, _FULL_STEP_PX = 1e-2, 1e-5


@dataclass(frozen=True)
class SaddleFit:
    """Fitted corners: ``position (corners, 2)`` as (u, v) px from the window's centre, and whether each is a corner.

    ``covariance``, px², is that of independent noise in the pixels; where the residuals are correlated, as a surface's
    own texture is, the scatter is ``correlation_gain`` times as large. One window's gain is a rough figure: average it.
    """

    position: Float[Tensor, "corners 2"]
    covariance: Float[Tensor, "corners 2 2"]
    correlation_gain: Float[Tensor, " corners"]
    blur_px: Float[Tensor, " corners"]
    contrast: Float[Tensor, " corners"]
    residual: Float[Tensor, " corners"]
    valid: Bool[Tensor, " corners"]


def fit_saddles(
    windows: Float[Tensor, "corners size size"],
    angles: Float[Tensor, "corners 2"],
    mask: Bool[Tensor, "corners size size"] | None = None,
    *,
    plain: bool = False,
    iterations: int = 12,
    max_shift_px: float = 3.0,
    max_residual: float = 0.35,
) -> SaddleFit:
    """Fit ``A0 + A1 E1 + A2 E2 + A3 E1 E2``, ``Ek = erf(dk / √2 s)``, to windows centred near checkerboard corners.

    d1 and d2 are the distances to the two edges that cross in the corner, s the blur. Each ``Ak = a + b u + c v``, so
    that every quadrant has a level and a gradient of its own: light falls off, print and paper are not even.
    Levenberg-Marquardt on 17 parameters a window; the covariance is the residual variance times the inverse normal
    matrix.

    Args:
        windows: grey values, odd size; the corner within about two pixels of the centre. One with a NaN is not valid.
        angles: direction of the normal of each edge, rad from u towards v; good to about 0.3 rad.
        mask: pixels to fit, all where None: those of the four squares around the corner, say.
        plain: fit one level and gradient to the whole window, good to a few hundredths of a pixel, and leave it there.
        iterations: largest number of steps of either model.
        max_shift_px: a corner further than this from the centre is not valid.
        max_residual: neither is one whose residual rms exceeds this share of its contrast.
    """
    if mask is None:
        mask = torch.ones_like(windows, dtype=torch.bool)
    stages = ((_PLAIN, _PLAIN_STEP_PX),) if plain else ((_PLAIN, _PLAIN_STEP_PX), (_FULL, _FULL_STEP_PX))
    together = max(1, _TOGETHER // (_PARAMETERS * windows.shape[-1] ** 2))
    fits = [
        _fit_together(*part, stages, iterations, max_shift_px, max_residual)
        for part in zip(windows.split(together), angles.split(together), mask.split(together), strict=True)
    ]
    return SaddleFit(*(torch.cat([getattr(fit, item.name) for fit in fits]) for item in fields(SaddleFit)))


def _fit_together(
    windows: Tensor,
    angles: Tensor,
    mask: Tensor,
    stages: Sequence[tuple[list[int], float]],
    iterations: int,
    max_shift_px: float,
    max_residual: float,
) -> SaddleFit:
    count, size, _ = windows.shape
    half = (size - 1) / 2
    axis = torch.arange(size, dtype=windows.dtype, device=windows.device) - half
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy")).flatten(1)
    complete = torch.isfinite(windows).flatten(1).all(-1)
    weight = mask.to(windows.dtype).reshape(count, -1)
    values = torch.where(complete[:, None], windows.reshape(count, -1), 0.0) * weight
    parameters = _initial_parameters(values, grid, weight, angles)
    for free, smallest_step in stages:
        parameters = _descend(parameters, values, grid, weight, free, smallest_step, iterations)
    model, jacobian = _saddle(parameters, grid, weight)
    residual = values - model
    variance = residual.square().sum(-1) / (weight.sum(-1) - _PARAMETERS).clamp(min=1)
    inverse = _inverse_normal(jacobian)
    position, contrast = parameters[:, _POSITION], parameters[:, _CONTRAST].abs()
    crossing = torch.sin(parameters[:, _ANGLE_1] - parameters[:, _ANGLE_2]).abs()
    valid = (
        complete
        & (torch.linalg.vector_norm(position, dim=-1) < max_shift_px)
        & (variance.sqrt() < max_residual * contrast)
        & (crossing > 0.2)  # edges nearly parallel: not a corner
        & (parameters[:, _BLUR] < half / 2)
    )
    return SaddleFit(
        position,
        inverse[:, _POSITION, _POSITION] * variance[:, None, None],
        correlation_gain(jacobian, inverse, _POSITION, residual, variance, size),
        parameters[:, _BLUR],
        contrast,
        variance.sqrt(),
        valid,
    )


def _descend(
    parameters: Tensor,
    values: Tensor,
    grid: Tensor,
    weight: Tensor,
    free: list[int],
    smallest_step: float,
    iterations: int,
) -> Tensor:
    """Levenberg-Marquardt on the ``free`` parameters, each window on its own until its corner stands still."""
    damping = torch.full_like(values[:, 0], 1e-3)
    moving = torch.ones_like(damping, dtype=torch.bool)
    model, jacobian = _saddle(parameters, grid, weight, free)
    cost = (values - model).square().sum(-1)
    for _ in range(iterations):
        step = torch.zeros_like(parameters)
        step[:, free] = _damped_step(jacobian, values - model, damping)
        trial = _bounded(parameters + step)
        trial_model, trial_jacobian = _saddle(trial, grid, weight, free)
        trial_cost = (values - trial_model).square().sum(-1)
        better = moving & (trial_cost < cost)
        parameters, model, jacobian, cost = (
            _better(better, *pair)
            for pair in ((trial, parameters), (trial_model, model), (trial_jacobian, jacobian), (trial_cost, cost))
        )
        damping = torch.where(better, damping / 10, damping * 5).clamp(1e-9, 1e6)
        moving = moving & (torch.linalg.vector_norm(step[:, _POSITION], dim=-1) > smallest_step)
        if not bool(moving.any()):
            break
    return parameters


def _better(better: Tensor, trial: Tensor, current: Tensor) -> Tensor:
    """The trial of the windows it is better for; no copy where that is all of them."""
    if bool(better.all()):
        return trial
    return torch.where(better.reshape(-1, *[1] * (trial.ndim - 1)), trial, current)


def _saddle(parameters: Tensor, grid: Tensor, weight: Tensor, free: list[int] = _FULL) -> tuple[Tensor, Tensor]:
    """Weighted model values (corners, pixels) and their Jacobian (corners, free, pixels), position to blur first."""
    position, blur = parameters[:, _POSITION], parameters[:, _BLUR, None]
    u, v = grid[0] - position[:, :1], grid[1] - position[:, 1:]
    edges = [_edge(u, v, parameters[:, angle, None], blur) for angle in (_ANGLE_1, _ANGLE_2)]
    (edge_1, rise_1, normal_1, along_1, across_1), (edge_2, rise_2, normal_2, along_2, across_2) = edges
    plane = torch.cat([torch.ones_like(grid[:1]), grid])
    levels = parameters[:, _LEVELS:].unflatten(-1, (4, 3)) @ plane
    shapes = torch.stack([torch.ones_like(edge_1), edge_1, edge_2, edge_1 * edge_2], dim=1)
    slope_1 = (levels[:, 1] + levels[:, 3] * edge_2) * rise_1
    slope_2 = (levels[:, 2] + levels[:, 3] * edge_1) * rise_2
    by_shape = [
        -(slope_1 * normal_1[0] + slope_2 * normal_2[0]),
        -(slope_1 * normal_1[1] + slope_2 * normal_2[1]),
        slope_1 * along_1,
        slope_2 * along_2,
        -(slope_1 * across_1 + slope_2 * across_2) / blur,
    ]
    by_levels = [shapes[:, index // 3] * plane[index % 3] for index in (k - _LEVELS for k in free if k >= _LEVELS)]
    jacobian = torch.stack([*by_shape, *by_levels], dim=1)
    return (levels * shapes).sum(1) * weight, jacobian.mul_(weight[:, None])


def _edge(
    u: Tensor, v: Tensor, angle: Tensor, blur: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor], Tensor, Tensor]:
    """Blurred unit edge through the corner, its derivative by distance, its normal, and distances along and from it."""
    cosine, sine = torch.cos(angle), torch.sin(angle)
    across, along = u * cosine + v * sine, v * cosine - u * sine
    scaled = across / (math.sqrt(2.0) * blur)
    rise = math.sqrt(2.0 / math.pi) / blur * torch.exp(-scaled.square())
    return torch.erf(scaled), rise, (cosine, sine), along, across


def _initial_parameters(values: Tensor, grid: Tensor, weight: Tensor, angles: Tensor) -> Tensor:
    """Corner at the centre, blur of one pixel, contrast by projection on that pattern (its sign matters)."""
    parameters = values.new_zeros(values.shape[0], _PARAMETERS)
    parameters[:, _ANGLE_1 : _ANGLE_2 + 1] = angles
    parameters[:, _BLUR] = 1.0
    parameters[:, _CONTRAST] = 1.0
    pattern, _ = _saddle(parameters, grid, weight)
    pixels = weight.sum(-1)
    mean, middle = values.sum(-1) / pixels, pattern.sum(-1) / pixels
    centred = pattern - middle[:, None] * weight
    parameters[:, _CONTRAST] = (centred * values).sum(-1) / centred.square().sum(-1)
    parameters[:, _OFFSET] = mean - parameters[:, _CONTRAST] * middle
    return parameters


def _damped_step(jacobian: Tensor, residual: Tensor, damping: Tensor) -> Tensor:
    """Levenberg-Marquardt step, in parameters scaled so that the unit of the grey values does not matter."""
    normal, length = _scaled_normal(jacobian)
    normal.diagonal(dim1=-2, dim2=-1).add_(damping[:, None])
    pull = (jacobian @ residual[..., None])[..., 0] / length
    return torch.linalg.solve(normal, pull) / length


def _inverse_normal(jacobian: Tensor) -> Tensor:
    normal, length = _scaled_normal(jacobian)
    return torch.linalg.pinv(normal, hermitian=True) / (length[:, None] * length[..., None])


def _scaled_normal(jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """Normal matrix of the Jacobian's rows at unit length, and their lengths."""
    normal = jacobian @ jacobian.mT
    length = normal.diagonal(dim1=-2, dim2=-1).sqrt()
    length = torch.where(length > 0, length, 1.0)  # without contrast nothing moves the corner
    return normal / (length[:, None] * length[..., None]), length


def _bounded(parameters: Tensor) -> Tensor:
    bounded = parameters.clone()
    bounded[:, _BLUR] = parameters[:, _BLUR].clamp(0.25, 20.0)  # a sharper edge than the pixel has no gradient left
    return bounded
