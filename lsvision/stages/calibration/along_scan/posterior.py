"""The errors along each scan, given all corners of all boards: what displaced its lines.

With the model linearised about the solution, corners, poses, n and processes are jointly Gaussian. Each board is
reduced by one QR to rows on its processes and its pose, and a few on n, which all boards share; what they say of n
together goes back into each board. Poses and n are so marginalised, not taken as known.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import solve_upper, upper_root
from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.edges import EdgeRows
from lsvision.stages.calibration.along_scan.evidence import Linearised
from lsvision.stages.calibration.along_scan.kernels import FINE, Knots
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Lever, Travel, latents
from lsvision.stages.calibration.along_scan.spectrum import Spectrum
from lsvision.stages.calibration.problem import BoardProblem

_POSE = 6
_FARTHEST = 1.0  # from a board, in its lengths: lines beyond move as those there


@dataclass(frozen=True)
class Processes:
    """Posterior of the processes of each board at knots along its scan, mm.

    The covariance of a component at the knots is ``factor @ factor.mT``.
    """

    travel: Travel
    lever: Lever
    knots: Knots
    mean: Float[Tensor, "boards 4 knots"]
    factor: Float[Tensor, "boards 4 knots columns"]

    def weights(self, board: int, travel_mm: Float[Tensor, "*lines"]) -> Float[Tensor, "*lines knots"]:
        """Weights of the knots of one board at lines of some travel; those too far away get that of the last knot."""
        return self.knots.weights((travel_mm - self.travel.start_mm[board]) / self.travel.extent_mm)

    def bend(self) -> "Processes":
        """The second derivative of the mean by the travel, 1/mm, in its place."""
        step = self.travel.extent_mm / self.knots.intervals
        inner = self.mean[..., 2:] - 2.0 * self.mean[..., 1:-1] + self.mean[..., :-2]
        return replace(self, mean=pad(inner / step.square(), (1, 1)))

    def displaced(self, points: Float[Tensor, "boards corners 3"]) -> Float[Tensor, "boards corners 3"]:
        """What measured points, mm, of each board were displaced by in the mean, mm."""
        weights = torch.stack([self.weights(board, travel) for board, travel in enumerate(points[..., 1])])
        return ((weights @ self.mean.mT)[..., None] * self.lever.directions(points)).sum(-2)


def processes_given_corners(
    problem: BoardProblem,
    linearised: Linearised,
    spectrum: Spectrum,
    reach: Float[Tensor, "boards 2"] | None = None,
    edges: EdgeRows | None = None,
) -> Processes:
    """Posterior of the processes of each board.

    Args:
        problem: of batch shape (), its white noise scaled as the residuals ask for.
        linearised: about the solution.
        spectrum: of the errors.
        reach: least and greatest travel, mm, of each scan; that of the corners if None.
        edges: of the boards.
    """
    travel = Travel.of(problem)
    knots = FINE if reach is None else _knots(travel, reach)
    roots = covariance_root(spectrum.covariance(knots))
    by_latents = latents(problem, roots[None], knots)
    columns = torch.cat([by_latents, linearised.columns], dim=-1)
    white = torch.linalg.solve_triangular(problem.noise_chol, columns, upper=False)
    white = torch.where(problem.valid[..., None, None], white, 0.0).flatten(1, 2)
    if edges is not None:
        further = edges.on_latents(roots[None].expand(problem.boards, -1, -1, -1), knots)
        rows = torch.cat([further[..., : by_latents.shape[-1]], linearised.of_edges(further)], dim=-1)
        white = torch.cat([white, rows], dim=1)
    mean, factor = _of_latents(white, by_latents.shape[-1], linearised.prior)
    mean, factor = (part.unflatten(1, (len(COMPONENTS), -1)) for part in (mean, factor))
    return Processes(travel, Lever.of(problem), knots, (roots @ mean[..., None])[..., 0], roots @ factor)


def _knots(travel: Travel, reach: Float[Tensor, "boards 2"]) -> Knots:
    """Knots as far as the scans reach, or as they are known at all."""
    place = ((reach - travel.start_mm[:, None]) / travel.extent_mm).clamp(-_FARTHEST, 1.0 + _FARTHEST)
    beyond = FINE.intervals * torch.stack([-place.amin(), place.amax() - 1.0])
    before, after = beyond.ceil().clamp(min=0.0).int().tolist()
    return Knots(FINE.density, before, after)


def _of_latents(
    white: Float[Tensor, "boards rows columns"], count: int, prior: Float[Tensor, "shared shared_and_one"]
) -> tuple[Float[Tensor, "boards latents"], Float[Tensor, "boards latents more"]]:
    """Mean and covariance factor of each board's standard normal latents, given the whitened rows of all boards.

    Args:
        white: columns are the ``count`` latents, the pose, what all boards share, and the residual.
        prior: rows on what they share.
    """
    own, shared = count + _POSE, prior.shape[-1] - 1
    unit = torch.eye(count, white.shape[-1], dtype=white.dtype, device=white.device)
    root = upper_root(torch.cat([unit.expand(len(white), -1, -1), white], dim=1))
    together = upper_root(torch.cat([prior, root[:, own:, own:].flatten(0, 1)]))
    eye = torch.eye(shared, dtype=white.dtype, device=white.device)
    solved = solve_upper(together[:shared, :shared], torch.cat([eye, together[:shared, shared:]], dim=-1))
    by_shared = root[:, :own, own:-1]
    right = root[:, :own, -1:] - by_shared @ solved[:, -1:]
    eye = torch.eye(own, dtype=white.dtype, device=white.device).expand(len(white), -1, -1)
    found = solve_upper(root[:, :own, :own], torch.cat([right, eye, by_shared @ solved[:, :-1]], dim=-1))[:, :count]
    return found[..., 0], found[..., 1:]
