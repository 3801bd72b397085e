"""Positions of the corners of a checkerboard in an image, by a fit of an analytic corner to each window."""

import torch
from torch import Tensor

_RADIUS = 5
_STEPS = 20
_DIFFERENCE = 1e-5
_SETTLED_PX = 1e-6


def fit_corners(image: Tensor, guess: Tensor, grid: tuple[int, int]) -> Tensor:
    """Least-squares centres ``(corners, 2)`` as (column, line) of a grey image ``(lines, columns)``, float64.

    The model is ``a + g·x + b erf(n1·(x - c) / s) erf(n2·(x - c) / s)``: two blurred edges of any direction that cross.
    """
    shifts = torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float64)
    window = torch.stack(torch.meshgrid(shifts, shifts, indexing="xy"), -1).reshape(-1, 2)
    base = guess.round()
    index = (base[:, None] + window).long()
    values = image.double()[index[..., 1], index[..., 0]]
    rows = guess.reshape(grid[1], grid[0], 2)
    along_x, along_y = (torch.gradient(rows, dim=dim)[0].reshape(-1, 2) for dim in (1, 0))
    angles = [torch.atan2(edge[:, 0], -edge[:, 1]) for edge in (along_x, along_y)]
    level, contrast = values.mean(-1), values.std(-1)
    ones = torch.ones_like(level)
    start = [*(guess - base).unbind(-1), *angles, ones, level, contrast, 0 * ones, 0 * ones]
    parameters = torch.stack(start, -1)
    # Either quadrant pair may be black: take the sign that starts nearer.
    flipped = parameters.clone()
    flipped[:, 6] *= -1
    error, error_flipped = ((_corner(p, window) - values).square().sum(-1) for p in (parameters, flipped))
    parameters = torch.where((error < error_flipped)[:, None], parameters, flipped)
    error, damping = torch.minimum(error, error_flipped), torch.full_like(error, 1e-2)
    for _ in range(_STEPS):  # Levenberg-Marquardt, each window with its own damping
        residual, jacobian = _corner(parameters, window) - values, _jacobian(parameters, window)
        normal = jacobian.mT @ jacobian
        damped = normal + (damping[:, None] * normal.diagonal(dim1=-2, dim2=-1)).diag_embed()
        tried = parameters - torch.linalg.solve(damped, jacobian.mT @ residual[..., None])[..., 0]
        tried_error = (_corner(tried, window) - values).square().sum(-1)
        better, moved = tried_error < error, (tried - parameters)[:, :2].abs().max()
        parameters, error = torch.where(better[:, None], tried, parameters), torch.minimum(error, tried_error)
        damping = damping * torch.where(better, 0.2, 10.0)
        if moved < _SETTLED_PX:
            break
    return base + parameters[:, :2]


def _jacobian(p: Tensor, window: Tensor) -> Tensor:
    step = _DIFFERENCE * torch.eye(p.shape[-1], dtype=p.dtype)
    upper, lower = (_corner(p[:, None] + sign * step, window) for sign in (1, -1))
    return ((upper - lower) / (2 * _DIFFERENCE)).mT


def _corner(parameters: Tensor, window: Tensor) -> Tensor:
    p = parameters[..., None].unbind(-2)
    x, y = window[:, 0] - p[0], window[:, 1] - p[1]
    edges = [torch.erf((x * torch.cos(angle) + y * torch.sin(angle)) / p[4]) for angle in (p[2], p[3])]
    return p[5] + p[7] * x + p[8] * y + p[6] * edges[0] * edges[1]
