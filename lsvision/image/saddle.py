"""Sub-pixel position of checkerboard corners: a parametric fit of the blurred saddle, all windows at once."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Columns of the parameter vector.
_POSITION, _ANGLE_1, _ANGLE_2, _BLUR, _CONTRAST, _OFFSET = slice(0, 2), 2, 3, 4, 5, 6
_PARAMETERS = 9  # the last two are the brightness gradient along u and v


@dataclass(frozen=True)
class SaddleFit:
    """Fitted corners: ``position (corners, 2)`` as (u, v) px from the window's centre, its covariance in px², and
    whether the window looks like a corner."""

    position: Float[Tensor, "corners 2"]
    covariance: Float[Tensor, "corners 2 2"]
    blur_px: Float[Tensor, " corners"]
    contrast: Float[Tensor, " corners"]
    residual: Float[Tensor, " corners"]
    valid: Bool[Tensor, " corners"]


def fit_saddles(
    windows: Float[Tensor, "corners size size"],
    angles: Float[Tensor, "corners 2"],
    *,
    iterations: int = 12,
    max_shift_px: float = 3.0,
    max_residual: float = 0.35,
) -> SaddleFit:
    """Fit ``b + g·(u, v) + c erf(d1 / √2 s) erf(d2 / √2 s)`` to windows centred near checkerboard corners.

    d1 and d2 are the distances to the two edges that cross in the corner, s the blur. Levenberg-Marquardt on nine
    parameters per window; the covariance is the residual variance times the inverse normal matrix.

    Args:
        windows: grey values, odd size; the corner within about two pixels of the centre. One with a NaN is not valid.
        angles: direction of the normal of each edge, rad from u towards v; good to about 0.3 rad.
        iterations: number of steps, the same for all windows.
        max_shift_px: a corner further than this from the centre is not valid.
        max_residual: neither is one whose residual rms exceeds this share of its contrast.
    """
    count, size, _ = windows.shape
    half = (size - 1) / 2
    axis = torch.arange(size, dtype=windows.dtype, device=windows.device) - half
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).reshape(1, -1, 2)
    values = windows.reshape(count, -1)
    complete = torch.isfinite(values).all(-1)
    values = torch.where(complete[:, None], values, 0.0)
    parameters = _initial_parameters(values, grid, angles)
    damping = torch.full((count,), 1e-2, dtype=values.dtype, device=values.device)
    model, jacobian = _saddle(parameters, grid)
    cost = (values - model).square().sum(-1)
    for _ in range(iterations):
        step = _damped_step(jacobian, values - model, damping)
        trial = _bounded(parameters + step)
        trial_model, trial_jacobian = _saddle(trial, grid)
        trial_cost = (values - trial_model).square().sum(-1)
        better = trial_cost < cost
        parameters = torch.where(better[:, None], trial, parameters)
        model = torch.where(better[:, None], trial_model, model)
        jacobian = torch.where(better[:, None, None], trial_jacobian, jacobian)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping / 5, damping * 5).clamp(1e-9, 1e6)
    variance = cost / (size * size - _PARAMETERS)
    inverse = torch.linalg.pinv(jacobian.mT @ jacobian, hermitian=True)
    position, contrast, residual = parameters[:, _POSITION], parameters[:, _CONTRAST].abs(), variance.sqrt()
    crossing = torch.sin(parameters[:, _ANGLE_1] - parameters[:, _ANGLE_2]).abs()
    valid = (
        complete
        & (torch.linalg.vector_norm(position, dim=-1) < max_shift_px)
        & (residual < max_residual * contrast)
        & (crossing > 0.2)  # edges nearly parallel: not a corner
        & (parameters[:, _BLUR] < half / 2)
    )
    covariance = inverse[:, _POSITION, _POSITION] * variance[:, None, None]
    return SaddleFit(position, covariance, parameters[:, _BLUR], contrast, residual, valid)


def _saddle(parameters: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Model values (corners, pixels) and their Jacobian (corners, pixels, 9)."""
    blur, contrast = parameters[:, _BLUR, None], parameters[:, _CONTRAST, None]
    offset = grid - parameters[:, None, _POSITION]
    edge_1, by_distance_1, normal_1, tangent_1 = _edge(offset, parameters[:, _ANGLE_1, None], blur)
    edge_2, by_distance_2, normal_2, tangent_2 = _edge(offset, parameters[:, _ANGLE_2, None], blur)
    slope_1, slope_2 = contrast * by_distance_1 * edge_2, contrast * by_distance_2 * edge_1
    along_1, along_2 = (offset * normal_1).sum(-1), (offset * normal_2).sum(-1)
    model = contrast * edge_1 * edge_2 + parameters[:, _OFFSET, None]
    model = model + (parameters[:, None, _OFFSET + 1 :] * grid).sum(-1)
    by_position = -(slope_1[..., None] * normal_1 + slope_2[..., None] * normal_2)
    columns = [
        by_position[..., 0],
        by_position[..., 1],
        slope_1 * (offset * tangent_1).sum(-1),
        slope_2 * (offset * tangent_2).sum(-1),
        -(slope_1 * along_1 + slope_2 * along_2) / blur,
        edge_1 * edge_2,
        torch.ones_like(model),
        grid[..., 0].expand_as(model),
        grid[..., 1].expand_as(model),
    ]
    return model, torch.stack(columns, dim=-1)


def _edge(offset: Tensor, angle: Tensor, blur: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blurred unit edge through the corner, its derivative by distance, and the edge's normal and tangent."""
    normal = torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)
    tangent = torch.stack([-torch.sin(angle), torch.cos(angle)], dim=-1)
    scaled = (offset * normal).sum(-1) / (math.sqrt(2.0) * blur)
    derivative = math.sqrt(2.0 / math.pi) / blur * torch.exp(-scaled.square())
    return torch.erf(scaled), derivative, normal, tangent


def _initial_parameters(values: Tensor, grid: Tensor, angles: Tensor) -> Tensor:
    """Corner at the centre, blur of one pixel, contrast by projection on that pattern (its sign matters)."""
    parameters = values.new_zeros(values.shape[0], _PARAMETERS)
    parameters[:, _ANGLE_1 : _ANGLE_2 + 1] = angles
    parameters[:, _BLUR] = 1.0
    parameters[:, _CONTRAST] = 1.0
    pattern, _ = _saddle(parameters, grid)
    mean = values.mean(-1)
    centred = pattern - pattern.mean(-1, keepdim=True)
    parameters[:, _CONTRAST] = (centred * values).sum(-1) / centred.square().sum(-1)
    parameters[:, _OFFSET] = mean - parameters[:, _CONTRAST] * pattern.mean(-1)
    return parameters


def _damped_step(jacobian: Tensor, residual: Tensor, damping: Tensor) -> Tensor:
    """Levenberg-Marquardt step, in parameters scaled so that the unit of the grey values does not matter."""
    length = torch.linalg.vector_norm(jacobian, dim=-2)
    length = torch.where(length > 0, length, 1.0)  # without contrast nothing moves the corner
    scaled = jacobian / length[:, None]
    normal = scaled.mT @ scaled + torch.diag_embed(damping[:, None].expand_as(length))
    return torch.linalg.solve(normal, scaled.mT @ residual[..., None])[..., 0] / length


def _bounded(parameters: Tensor) -> Tensor:
    bounded = parameters.clone()
    bounded[:, _BLUR] = parameters[:, _BLUR].clamp(0.25, 20.0)  # a sharper edge than the pixel has no gradient left
    return bounded
