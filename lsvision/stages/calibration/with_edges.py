"""A solution whose boards shook, once more with the edges of their squares on every line.

Corners show a vibration at their rows alone. Where the residuals of the corners give evidence for errors along the
scan, the edges between them show these on every line; corners, edges, poses, n and the processes are then one problem.
Its corners and its edges each have noise as large as their own residuals say.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan import (
    FINE,
    SEARCHED,
    SUSPICION,
    EdgeRows,
    ErrorsAlongScan,
    Linearised,
    by_chance,
    edge_rows,
    search_with_edges,
    with_processes,
)
from lsvision.stages.calibration.along_scan.kernels import wave_length
from lsvision.stages.calibration.along_scan.lines import Travel
from lsvision.stages.calibration.along_scan.windows import Windows
from lsvision.stages.calibration.model import refitted, residuals_in_sigmas
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.solution import estimate_white, wider
from lsvision.stages.calibration.solved import Solution
from lsvision.types import BoardEdges

_LEVEL = 1e-3  # probability of corners' residuals below which their noise is scaled
# Scale of the corners' noise at first: a vibration bends the edges in their windows, which displaces them.
_DOUBTED = 25.0
_ROUNDS = 2


def with_edges(solution: Solution, edges: Sequence[BoardEdges | None]) -> Solution:
    """The solution of one problem, in which errors along the scans were found, with edges of its boards.

    Returns:
        The given one where no edges were found.
    """
    rows = edge_rows(solution.problem, refitted(solution.problem, solution.posterior.mean), edges)
    if not rows.values:
        return solution
    scale = torch.full_like(solution.noise_scale, _DOUBTED)
    found = _estimated(replace(solution, noise_scale=scale), rows)
    for _ in range(_ROUNDS):
        problem = _unbent(solution.problem, found)
        scale = _noise_scale(problem, found)
        found = _estimated(replace(found, problem=problem, noise_scale=scale), rows)
    whitened = residuals_in_sigmas(found.steadied, found.posterior.mean) / scale.sqrt()
    unlike = by_chance(found.steadied, whitened) < SUSPICION
    return replace(found, along_scan=replace(found.along_scan, unlike=unlike))


def _estimated(solution: Solution, edges: EdgeRows) -> Solution:
    """A solution once more, with edges: its errors along the scan are where the search for them starts from."""
    config = solution.config
    problem = solution.problem.scaled(solution.noise_scale)
    # About poses that leave the least residuals: those of the posterior are off by what long waves are.
    linearised = Linearised.of(problem, refitted(problem, solution.posterior.mean), config.prior_sigma)
    errors = search_with_edges(
        problem, linearised, edges, None if solution.edges is None else solution.along_scan.spectrum
    )
    noise = with_processes(problem, covariance_root(errors.covariance(FINE))[None], FINE, edges)
    estimate = estimate_white(replace(problem, correlated=noise), solution.start, config)
    along = ErrorsAlongScan(
        found=solution.along_scan.found,
        unlike=solution.along_scan.unlike,
        rms_mm=errors.rms_mm,
        length_mm=wave_length(errors.covariance(SEARCHED)) * Travel.of(problem).extent_mm,
        spectrum=errors.spectrum,
        log_ratio=errors.log_ratio,
        factor_of_n=errors.factor_of_shared,
        noise=noise,
    )
    return replace(
        solution,
        posterior=wider(estimate.posterior, errors.factor_of_shared),
        scatter=estimate.scatter,
        along_scan=along,
        edges=edges,
    )


def _unbent(problem: BoardProblem, found: Solution) -> BoardProblem:
    """A problem whose corners lie where they would if a vibration had not bent the edges in their windows."""
    windows, travel = Windows.of(problem, found.posterior.mean), Travel.of(problem)
    end = travel.start_mm + travel.extent_mm
    reach = torch.stack([travel.start_mm - windows.spacing_mm / 2, end + windows.spacing_mm / 2], dim=-1)
    processes = found.processes((), reach)
    moved = torch.where(problem.valid[..., None], processes.displaced(problem.points), 0.0)
    steadied = replace(problem, points=problem.points - moved)
    off = windows.off(processes, problem, residuals_in_sigmas(steadied, found.posterior.mean))
    return replace(problem, points=problem.points - off)


def _noise_scale(problem: BoardProblem, found: Solution) -> Tensor:
    """Reduced chi-square of the corners of a problem, their lines steadied, where it is larger than chance allows."""
    steadied = replace(found, problem=problem).steadied
    squared = residuals_in_sigmas(steadied, found.posterior.mean).square().sum()
    freedom = 3.0 * problem.valid.sum() - 6.0 * problem.boards
    unlikely = chi_square_tail(squared, freedom) < _LEVEL
    return torch.where(unlikely, squared / freedom, 1.0)
