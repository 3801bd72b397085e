"""The calibration by a filter that takes the corners one by one in line order, so that n may drift along the scans."""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.estimation import (
    Gaussian,
    Info,
    Posterior,
    StateSpace,
    Track,
    apply,
    filter_sequence,
    nees,
)  # fmt: skip
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.joint import covering, joint, mode_of, widened_where_open
from lsvision.stages.calibration.linearise import corner_rows, point_factor
from lsvision.stages.calibration.prior import prior_about
from lsvision.stages.calibration.problem import BoardProblem

# Sigma, rad or mm, of a flat prior where a filter needs a number.
_FLAT = 1e5


def sequential(problem: BoardProblem, start: Float[Tensor, "*batch state"], config: CalibrationConfig) -> Posterior:
    """Filter corner by corner, board after board in line order; n walks at random by the travel between corners.

    The result is n at the end of the last scan. The passes begin at the mode of an n that stands still. Each filters
    from the same prior with the corners linearised about the pass before: the boards' poses do not move, so that their
    last state is their smoothed one. Corners that err together are no sequence of measurements: they are taken at once,
    and n stands still. Where a linearisation does not hold, the covariance is the second moment of an n
    that stands still, and the random walk's.

    Corners that err together are no sequence of measurements: they are taken at once, and n stands still.
    """
    if problem.correlated is not None:
        return joint(problem, start, config)
    prior = prior_about(start, config)
    mode = mode_of(problem, prior, start, config)
    mean, path = torch.where(mode.converged[..., None], mode.state, start), [start]
    factor, running = point_factor(start), torch.ones_like(start[..., 0], dtype=torch.bool)
    lost, iterations = ~running, torch.zeros_like(running, dtype=torch.long)
    for _ in range(config.max_iterations):
        increment = filtered(problem, start, mean, config).last
        found = torch.isfinite(increment.mean).all(-1) & torch.isfinite(increment.factor).all((-2, -1))
        moved = nees(increment.mean, increment.factor) / 2
        lost, running = lost | (running & ~found), running & found
        mean = torch.where(running[..., None], mean + increment.mean, mean)
        factor = torch.where(running[..., None, None], increment.factor, factor)
        path.append(mean)
        iterations = iterations + running
        running = running & ~(moved <= config.tolerance)
        if not bool(running.any()):
            break
    converged = ~running & ~lost
    walk = LineOrder.of(problem).walked(config.process_sigma or 0.0)
    covered = covering(problem, prior, Gaussian(mean, factor), walk, config)
    converged = converged & covered.found
    result = widened_where_open(problem, prior, Gaussian(mean, covered.factor), converged)
    return as_posterior(result, torch.stack(path), iterations, converged)


def filtered(
    problem: BoardProblem, start: Float[Tensor, "*batch state"], mean: Float[Tensor, "*batch state"],
    config: CalibrationConfig,
) -> Track:  # fmt: skip
    """One pass over all corners, linearised about ``mean``; its states are increments from there.

    Args:
        start: mean of the prior.
    """
    order, unit = LineOrder.of(problem), torch.eye(3, dtype=start.dtype, device=start.device)
    rows = order.sort(corner_rows(problem, mean, point_factor(mean)))
    process_chol = order.process_chol(config.process_sigma or 0.0)
    model = StateSpace(partial(_corner_values, rows[..., :-1]), noise_chol=unit, process_chol=process_chol)
    return filter_sequence(
        model, Gaussian(start - mean, _wide_chol(start, config)), rows[..., -1], order.valid, history=False
    )


def as_posterior(result: Gaussian, path: Tensor, iterations: Tensor, converged: Tensor) -> Posterior:
    """The result with its status: singular where it is not finite."""
    finite = torch.isfinite(result.factor).all((-2, -1)) & torch.isfinite(result.mean).all(-1)
    info = torch.where(converged, int(Info.OK), int(Info.NOT_CONVERGED))
    info = torch.where(finite, info, int(Info.SINGULAR))
    return Posterior(result.mean, result.factor, path, iterations, info == int(Info.OK), info)


@dataclass(frozen=True)
class LineOrder:
    """The corners of all boards of a problem in the order in which they are scanned, steps first.

    Boards follow one another; corners that were not seen come last on their board and take no travel.
    """

    index: Int[Tensor, "*batch boards corners"]
    valid: Bool[Tensor, "steps *batch"]
    travel_mm: Float[Tensor, "steps *batch"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "LineOrder":
        """The order of a problem's corners, and the travel from each to the next."""
        travel = torch.where(problem.valid, problem.points[..., 1].abs(), torch.inf)
        travel, index = travel.sort(dim=-1)
        between = torch.nn.functional.pad(travel.diff(dim=-1), (1, 0)).flatten(-2).movedim(-1, 0)
        valid = _sorted(problem.valid, index)
        return cls(index, valid, torch.where(valid, between, 0.0))

    def sort(
        self, values: Float[Tensor, "*batch boards corners rows columns"]
    ) -> Float[Tensor, "steps *batch rows columns"]:
        """Values of all corners in line order."""
        return _sorted(values, self.index)

    def process_chol(self, sigma: float) -> Float[Tensor, "steps *batch state state"]:
        """√Q of an n that walks at random by ``sigma`` per square root of a mm; the poses stand still."""
        walk = sigma * self.travel_mm.sqrt()
        moving = torch.cat([walk.new_zeros(6 * self.index.shape[-2]), walk.new_ones(3)])
        return torch.diag_embed(walk[..., None] * moving)

    def walked(self, sigma: float) -> Float[Tensor, "*batch state state"]:
        """√Q of the walk over all corners."""
        travel = self.travel_mm.movedim(0, -1).contiguous().sum(-1)
        moving = torch.cat([travel.new_zeros(6 * self.index.shape[-2]), travel.new_ones(3)])
        return torch.diag_embed(sigma * travel.sqrt()[..., None] * moving)


def _sorted(values: Tensor, index: Tensor) -> Tensor:
    """``(*batch, boards, corners, ..)`` by an index ``(*batch, boards, corners)``, as ``(steps, *batch, ..)``."""
    batch = index.ndim - 2
    by_value = index.reshape(*index.shape, *(1,) * (values.ndim - index.ndim)).expand_as(values)
    return values.gather(batch + 1, by_value).flatten(batch, batch + 1).movedim(batch, 0)


def _corner_values(A: Tensor, points: Tensor, step: int) -> Tensor:
    """Linearised corner of a step; the points are copied, so that sums take one order (see ``estimation.linalg``)."""
    return apply(A[step], points.contiguous())


def _wide_chol(start: Tensor, config: CalibrationConfig) -> Tensor:
    """Cholesky factor of the prior; a flat part gets a sigma so wide that its weight is lost in rounding."""
    sigma = prior_about(start, config).root.diagonal(dim1=-2, dim2=-1).clamp(min=1 / _FLAT).reciprocal()
    return torch.diag_embed(sigma)
