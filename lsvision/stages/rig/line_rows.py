"""What the motion of the lines does to the corners in both raw images: rows on processes along the travel, in sigmas.

Each camera sees the object displaced by what its own line says. Columns and travels are linear in it to a hundredth of
a pixel: a corner's residual is C⁻¹ J W f and white noise, C the factor of its covariance, J the derivative of where a
camera sees the point by (x, travel, z), W f the processes at that camera's line.

A corner is where straight lines through its two edges meet, and in the window in which they are fitted the motion bends
them. Each passes where its edge was in the mean of the window's lines. With the normals k and l of the two edges in the
image, a corner whose own line displaces it by a is found at p,

    k · p = k · a L_k,    l · p = l · a L_l,

L_k and L_l the means of the process over the lines that the edges cross. So the window is part of J W.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import BorderedState, block_rows
from lsvision.stages.calibration.along_scan import FINE, Lever, NormalEquations, Travel
from lsvision.stages.rig.model import SHARED
from lsvision.stages.rig.seen_motion import SeenMotion
from lsvision.stages.rig.sightings import Sightings
from lsvision.stages.rig.solve import RigSolution, corner_residuals

LARGEST_SHARE = 0.5
"""Of the corners' spacing, that a window reaches to either side of its corner."""
_NODES = 6  # of the mean over a window


@dataclass(frozen=True)
class LineRows:
    """Rows of all corners of a problem about a solution, those that it left out among them.

    ``directions`` are the derivatives of a corner's two residuals in each image by what each component displaces each
    of its edges by, sigmas per mm, zero where it was not seen. ``lines`` are the travels at which either camera saw it,
    ``reach`` the travel over which the edges of a board go in a window, over its size.
    """

    solution: RigSolution
    seen: Bool[Tensor, "boards corners"]
    residuals: Float[Tensor, "boards corners 4"]
    directions: Float[Tensor, "boards corners 2 edges 2 components"]
    lines: Float[Tensor, "boards corners 2"]
    reach: Float[Tensor, "boards edges"]
    travel: Travel
    spacing_mm: float

    @classmethod
    def of(cls, solution: RigSolution, sightings: Sightings) -> "LineRows":
        """Those of all corners of one problem about a solution."""
        eyes, seen = (sightings.left, sightings.right), sightings.valid
        lines = torch.stack([eye.position[..., 1] for eye in eyes], dim=-1)
        board = sightings.board_points
        spacing_mm = float((torch.cdist(board, board) + 1e9 * torch.eye(len(board))).amin())
        motion = SeenMotion.of(solution)
        components = Lever.about(motion.points, seen).directions(motion.points).mT[..., None, None, :, :]
        factor = torch.stack([eye.factor for eye in eyes], dim=-3)[..., None, :, :]
        directions = torch.linalg.solve_triangular(factor, motion.by_edge @ components, upper=False)
        return cls(
            solution=solution,
            seen=seen,
            residuals=corner_residuals(solution.model, sightings, solution.found.state),
            directions=torch.where(seen[..., None, None, None, None], directions, 0.0),
            lines=lines,
            reach=motion.reach,
            travel=_travel(lines, seen, LARGEST_SHARE * spacing_mm),
            spacing_mm=spacing_mm,
        )

    def by_knots(
        self, kept: Bool[Tensor, "boards corners"], share: float
    ) -> Float[Tensor, "boards rows components knots"]:
        """Rows of the corners that are kept on the processes at the knots, of 1 mm; zero of others.

        Args:
            share: of the corners' spacing, that windows reach to either side.
        """
        directions = torch.where(kept[..., None, None, None, None], self.directions, 0.0)
        rows = torch.einsum("bpeirc,bpeik->bperck", directions, self._weights(share))
        return rows.flatten(1, 3)

    def by_latents(
        self, roots: Float[Tensor, "components knots rank"], kept: Bool[Tensor, "boards corners"], share: float
    ) -> Float[Tensor, "boards rows latents"]:
        """Rows on standard normal latents of processes of given roots, mm."""
        return torch.einsum("brck,ckl->brcl", self.by_knots(kept, share), roots).flatten(-2)

    def equations(self, share: float) -> NormalEquations:
        """Normal equations of the solution's corners on the processes, and on poses, rig and motion."""
        kept, shared = self.solution.sightings.valid, self.solution.found.state.shared
        return NormalEquations.of_rows(
            by_knot=self.by_knots(kept, share).flatten(-2),
            by_state=self._by_state,
            prior=torch.cat([torch.eye(SHARED, dtype=shared.dtype), -shared[:, None]], dim=-1),
            values=4.0 * float(kept.sum()),
            rms_mm=self._rms_mm(kept),
        )

    @cached_property
    def _by_state(self) -> Float[Tensor, "boards rows columns"]:
        """Rows of the solution's corners on the pose, on rig and motion, and their residuals."""
        kept, model = self.solution.sightings, self.solution.model

        def residuals(moved: BorderedState) -> Tensor:
            return corner_residuals(model, kept, moved).flatten(-2)

        rows = block_rows(residuals, self.solution.found.state)
        return torch.cat([-rows[..., :-1], rows[..., -1:]], dim=-1)

    def _weights(self, share: float) -> Float[Tensor, "boards corners 2 edges knots"]:
        """Weights of the knots in the means over windows."""
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        half = share * self.spacing_mm * self.reach[:, None, None, :]
        middle = self.lines[..., None] - self.travel.start_mm[:, None, None, None]
        parts = [
            0.5 * weight * FINE.weights((middle + node * half) / self.travel.extent_mm)
            for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True)
        ]
        return torch.stack(parts).sum(0)

    def _rms_mm(self, kept: Bool[Tensor, "boards corners"]) -> Float[Tensor, " components"]:
        """What each component alone would displace the corners by, to explain their residuals best: rms."""
        directions = self.directions.sum(-3).flatten(-3, -2)
        size = (directions * self.residuals[..., None]).sum(-2) / directions.square().sum(-2).clamp(min=1e-300)
        return (torch.where(kept[..., None], size, 0.0).square().sum((0, 1)) / kept.sum()).sqrt()


def _travel(lines: Tensor, seen: Tensor, beyond_mm: float) -> Travel:
    """Knots as far as either camera sees the corners, and some mm beyond."""
    both = torch.cat([lines - beyond_mm, lines + beyond_mm], dim=-1)
    return Travel.spanning(both.flatten(-2), seen[..., None].expand(both.shape).flatten(-2))
