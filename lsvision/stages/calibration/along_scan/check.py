"""Whether errors along the scan, as they are modelled, can be what displaces the corners.

The corners are fitted with the processes, the poses and n. Then each board's processes are as large as their kernels
say: a scan that shook far more than the others, or a jump, is none of their draws. And what is left is white: errors
that no component of ``lines`` describes would leave waves along the travel.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.stages.calibration.along_scan.evidence import Linearised
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Travel, directions, half_waves, latents
from lsvision.stages.calibration.problem import BoardProblem

SUSPICION = 0.002  # probability of residuals below which they are called correlated
_ORDERS = 10  # of half-waves over the travel, that the residuals are tested for
_IMPROBABLE = 1e-3  # probability of processes as large as those of a board, below which they are not what was modelled


def by_chance(problem: BoardProblem, whitened: Float[Tensor, "*batch boards corners 3"]) -> Float[Tensor, "*batch"]:
    """Probability, at most, that residuals are as much correlated along the travel by chance.

    They are projected on half-waves over each board's travel, in every component, and in a travel that is wrong in
    proportion to the place across the line, which no component describes. Of white residuals the squares, over all
    boards, are chi-square variables, and what the fit of poses and n takes makes them smaller.

    Args:
        whitened: residuals of the corners in sigmas, zero where ``valid`` is false.
    """
    roll = directions(problem)[..., COMPONENTS.index("roll"), :]
    turned = roll[..., 2] * whitened[..., 1]
    along = torch.cat([whitened, torch.stack([(roll * whitened).sum(-1), turned], dim=-1)], dim=-1)
    levers = torch.stack([roll.square().sum(-1), roll[..., 2].square()], dim=-1)
    weight = torch.cat([torch.ones_like(whitened), levers], dim=-1)
    by_order = []
    for half_wave in half_waves(Travel.of(problem).place(problem), _ORDERS):
        wave = torch.where(problem.valid, half_wave, 0.0)[..., None]
        squares = (wave * along).sum(-2).square()
        by_order.append((squares / (wave.square() * weight).sum(-2).clamp(min=1e-6)).sum(-2))
    by_wave = torch.stack(by_order, dim=-1)
    single = chi_square_tail(by_wave, float(problem.boards))
    together = chi_square_tail(by_wave[..., :3, :].sum(-1), float(problem.boards * (_ORDERS + 1)))
    tests = torch.cat([single.flatten(-2), together], dim=-1)
    return tests.amin(-1) * tests.shape[-1]


def can_be(problem: BoardProblem, linearised: Linearised, roots: Float[Tensor, "_ 4 knots columns"]) -> bool:
    """Whether processes of given roots, mm, can be what displaces the corners of a problem of batch shape ()."""
    by_latents, boards = latents(problem, roots), problem.boards
    both = torch.cat([by_latents, linearised.columns], dim=-1)
    white = torch.linalg.solve_triangular(problem.noise_chol, both, upper=False)
    white = torch.where(problem.valid[..., None, None], white, 0.0).flatten(1, 2)
    process, state = white.split([by_latents.shape[-1], linearised.columns.shape[-1]], dim=-1)
    axes, size, _ = torch.linalg.svd(process, full_matrices=False)
    sigma = (1.0 + size.square()).sqrt()  # of the corners along the axes, where they err by the processes too
    shrink = axes * (1.0 - 1.0 / sigma)[..., None, :]
    error = _error_of_fit(state - shrink @ (axes.mT @ state), linearised.prior)
    along_axes = (axes.mT @ error[..., None])[..., 0]
    large = size > 1.0  # where a process stands out of the noise
    by_board = chi_square_tail((large * along_axes.square()).sum(-1), large.sum(-1).clamp(min=1))
    rest = (error - (shrink @ along_axes[..., None])[..., 0]).unflatten(-1, (-1, 3))  # the noise as it was estimated
    freedom = 3.0 * problem.valid.sum() - (1.0 - sigma**-2).sum()
    scale = (rest.square().sum() / freedom).clamp(min=1.0)
    probable = bool(by_board.amin() * boards > _IMPROBABLE)
    return probable and bool(by_chance(problem, rest / scale.sqrt()) > SUSPICION)


def _error_of_fit(rows: Tensor, prior: Tensor) -> Tensor:
    """What a fit of each board's pose and of what they share leaves of whitened rows, ``(boards, rows)``."""
    pose, shared, right = rows.split([6, prior.shape[-1] - 1, 1], dim=-1)
    A = torch.cat([torch.block_diag(*pose), shared.flatten(0, 1)], dim=-1)
    by_prior = torch.nn.functional.pad(prior[:, :-1], (A.shape[-1] - len(prior), 0))
    scale = torch.linalg.vector_norm(A, dim=0).clamp(min=1e-300)
    both = torch.cat([A, by_prior]) / scale
    best = torch.linalg.lstsq(both, torch.cat([right.flatten(0, 1), prior[:, -1:]])).solution
    return (right.flatten(0, 1) - A / scale @ best).unflatten(0, rows.shape[:2])[..., 0]
