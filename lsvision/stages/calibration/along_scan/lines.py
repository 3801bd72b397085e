"""How the lines of a scan can be displaced: four components, and the knots along the travel at which each is described.

A displaced line moves its corners by f(travel) d, d the direction of the component: sideways (x), along (travel), in
depth (z), or by a turn of the object about the travel (roll), whose lever is the corner's place across the line and in
depth. The lever is counted from the middle of the board's corners: what another axis would add is a displacement in x
and z. Its unit is the rms lever of all corners, so that f is in mm for all components.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation.gaussian_process import cubic_weights
from lsvision.stages.calibration.along_scan.kernels import INTERVALS, KNOTS
from lsvision.stages.calibration.problem import BoardProblem

COMPONENTS: tuple[Literal["x", "travel", "z", "roll"], ...] = ("x", "travel", "z", "roll")


@dataclass(frozen=True)
class Travel:
    """Where the boards' corners lie on the knots: the travel at which each board begins, and that of a unit, mm."""

    start_mm: Float[Tensor, "*batch boards"]
    extent_mm: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "Travel":
        """Of a problem; its longest board sets the unit."""
        travel = problem.points[..., 1]
        start = torch.where(problem.valid, travel, torch.inf).amin(-1)
        end = torch.where(problem.valid, travel, -torch.inf).amax(-1)
        return cls(start, (end - start).amax(-1).clamp(min=1e-9))

    def place(self, problem: BoardProblem) -> Float[Tensor, "*batch boards corners"]:
        """The travel of each corner from the begin of its board, in units."""
        return (problem.points[..., 1] - self.start_mm[..., None]) / self.extent_mm[..., None, None]

    def weights(self, problem: BoardProblem) -> Float[Tensor, "*batch boards corners knots"]:
        """Weights of the knots at each corner, zero where ``valid`` is false."""
        return torch.where(problem.valid[..., None], cubic_weights(1.0 + INTERVALS * self.place(problem), KNOTS), 0.0)

    def walk(self, process_sigma: float) -> Float[Tensor, "*batch boards knots knots"]:
        """Covariance at the knots, mm², of what each component is displaced by where n walks at random along the scan.

        It is counted from the end of each board, where n is asked for; ``process_sigma`` is per square root of a mm.
        """
        place = (torch.arange(KNOTS, dtype=self.start_mm.dtype, device=self.start_mm.device) - 1.0) / INTERVALS
        travel = self.start_mm[..., None] + self.extent_mm[..., None, None] * place
        left = self.extent_mm[..., None, None] * (1.0 - place).clamp(min=0.0)
        by_n = torch.minimum(left[..., :, None], left[..., None, :])
        return process_sigma**2 * travel[..., :, None] * travel[..., None, :] * by_n


def directions(problem: BoardProblem) -> Float[Tensor, "*batch boards corners 4 3"]:
    """The direction in which each component displaces each corner."""
    points = torch.where(problem.valid[..., None], problem.points, torch.nan)
    lever = (points - points.nanmean(-2, keepdim=True)).nan_to_num(nan=0.0)
    roll = torch.stack([lever[..., 2], torch.zeros_like(lever[..., 0]), -lever[..., 0]], dim=-1)
    count = problem.valid.sum((-2, -1))
    rms = (roll.square().sum((-3, -2, -1)) / count).sqrt().clamp(min=1e-9)
    straight = torch.eye(3, dtype=roll.dtype, device=roll.device).expand(*roll.shape[:-1], 3, 3)
    return torch.cat([straight, (roll / rms[..., None, None, None])[..., None, :]], dim=-2)


def latents(
    problem: BoardProblem, roots: Float[Tensor, "#boards 4 knots columns"]
) -> Float[Tensor, "boards corners 3 latents"]:
    """What standard normal latents of each board displace its corners by, mm, for processes given by their roots.

    Args:
        problem: of batch shape ().
    """
    at_corners = Travel.of(problem).weights(problem)[:, None] @ roots
    by_component = directions(problem).movedim(-2, 1)[..., None] * at_corners[..., None, :]
    return by_component.permute(0, 2, 3, 1, 4).flatten(-2)


def half_waves(place: Float[Tensor, "*batch"], orders: int) -> Iterator[Float[Tensor, "*batch"]]:
    """cos(k π place) for k = 0 .. ``orders``, by the recurrence of Chebyshev's polynomials."""
    first = torch.cos(torch.pi * place)
    before, wave = first, torch.ones_like(first)
    for _ in range(orders + 1):
        yield wave
        before, wave = wave, 2.0 * first * wave - before
