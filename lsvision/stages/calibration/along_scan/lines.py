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
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.stages.calibration.along_scan.kernels import SEARCHED, Knots
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
        return cls.spanning(problem.points[..., 1], problem.valid)

    @classmethod
    def spanning(
        cls, travel: Float[Tensor, "*batch boards corners"], valid: Bool[Tensor, "*batch boards corners"]
    ) -> "Travel":
        """Of corners at some travel, mm."""
        start = torch.where(valid, travel, torch.inf).amin(-1)
        end = torch.where(valid, travel, -torch.inf).amax(-1)
        return cls(start, (end - start).amax(-1).clamp(min=1e-9))

    def place(self, problem: BoardProblem) -> Float[Tensor, "*batch boards corners"]:
        """The travel of each corner from the begin of its board, in units."""
        return (problem.points[..., 1] - self.start_mm[..., None]) / self.extent_mm[..., None, None]

    def weights(self, problem: BoardProblem, knots: Knots = SEARCHED) -> Float[Tensor, "*batch boards corners knots"]:
        """Weights of the knots at each corner, zero where ``valid`` is false."""
        return torch.where(problem.valid[..., None], knots.weights(self.place(problem)), 0.0)

    def walk(self, process_sigma: float, knots: Knots) -> Float[Tensor, "*batch boards 4 knots knots"]:
        """Covariance at knots, mm², of what each component is displaced by where n walks at random along the scan.

        It is counted from the end of each board, where n is asked for; ``process_sigma`` is per square root of a mm.
        """
        place = knots.place(self.start_mm)
        travel = self.start_mm[..., None] + self.extent_mm[..., None, None] * place
        left = self.extent_mm[..., None, None] * (1.0 - place).clamp(min=0.0)
        by_n = torch.minimum(left[..., :, None], left[..., None, :])
        walk = process_sigma**2 * travel[..., :, None] * travel[..., None, :] * by_n
        moved = walk.new_tensor([component != "roll" for component in COMPONENTS])
        return walk[..., None, :, :] * moved[:, None, None]


@dataclass(frozen=True)
class Lever:
    """The levers of a turn about the travel: counted from the ``middle`` of each board's corners, ``rms_mm`` of all."""

    middle: Float[Tensor, "*batch boards 3"]
    rms_mm: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, problem: BoardProblem) -> "Lever":
        """Those of a problem's corners."""
        return cls.about(problem.points, problem.valid)

    @classmethod
    def about(
        cls, points: Float[Tensor, "*batch boards corners 3"], valid: Bool[Tensor, "*batch boards corners"]
    ) -> "Lever":
        """Those of corners at (x, travel, z), mm."""
        seen = torch.where(valid[..., None], points, torch.nan)
        middle = seen.nanmean(-2)
        across = (seen - middle[..., None, :])[..., ::2].nan_to_num(nan=0.0)
        rms = (across.square().sum((-3, -2, -1)) / valid.sum((-2, -1))).sqrt().clamp(min=1e-9)
        return cls(middle, rms)

    def directions(self, points: Float[Tensor, "*batch boards points 3"]) -> Float[Tensor, "*batch boards points 4 3"]:
        """The direction in which each component displaces points of the boards."""
        x, y, z = (points - self.middle[..., None, :]).unbind(-1)
        roll = torch.stack([z, torch.zeros_like(y), -x], dim=-1) / self.rms_mm[..., None, None, None]
        straight = torch.eye(3, dtype=roll.dtype, device=roll.device).expand(*roll.shape[:-1], 3, 3)
        return torch.cat([straight, roll[..., None, :]], dim=-2)


def directions(problem: BoardProblem) -> Float[Tensor, "*batch boards corners 4 3"]:
    """The direction in which each component displaces each corner."""
    seen = problem.valid[..., None]
    lever = Lever.of(problem)
    return lever.directions(torch.where(seen, problem.points, lever.middle[..., None, :]))


def latents(
    problem: BoardProblem,
    roots: Float[Tensor, "#boards 4 knots columns"],
    knots: Knots = SEARCHED,
    travel: Travel | None = None,
) -> Float[Tensor, "boards corners 3 latents"]:
    """What standard normal latents of each board displace its corners by, mm, for processes given by their roots.

    Args:
        problem: of batch shape (). knots: at which the roots are. travel: where these lie; on the corners if None.
    """
    at_corners = (travel or Travel.of(problem)).weights(problem, knots)[:, None] @ roots
    by_component = directions(problem).movedim(-2, 1)[..., None] * at_corners[..., None, :]
    return by_component.permute(0, 2, 3, 1, 4).flatten(-2)


def half_waves(place: Float[Tensor, "*batch"], orders: int) -> Iterator[Float[Tensor, "*batch"]]:
    """cos(k π place) for k = 0 .. ``orders``, by the recurrence of Chebyshev's polynomials."""
    first = torch.cos(torch.pi * place)
    before, wave = first, torch.ones_like(first)
    for _ in range(orders + 1):
        yield wave
        before, wave = wave, 2.0 * first * wave - before
