"""Where a corner is found whose edges a motion bends: the window around it levels the motion.

A corner is where straight lines through its two edges meet. Each line is fitted in a square window of 2 r, and passes
where its edge was in the mean of its lines: off the corner by b, the mean motion of these lines less that of the
corner's own. With the normals k and l of the two edges in the plane of columns and lines, the corner is found off by p,

    k · p = k · b_k,    l · p = l · b_l.

An edge along the lines is bent by nothing, and the corner slides on it: on a board that is turned also along the
travel, though the motion is none along it. An error of a few micrometres there is one of the stretch.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import scan_position
from lsvision.stages.calibration.along_scan.posterior import Processes
from lsvision.stages.calibration.model import rotations
from lsvision.stages.calibration.problem import BoardProblem, BoardState

_NODES = 6  # of the mean over a window
_FIRST_SHARE, _LARGEST_SHARE = 0.1, 0.5  # r over the corners' spacing: where the search for it begins, its bound
_ROUNDS = 4


@dataclass(frozen=True)
class Windows:
    """Edges in the windows around the corners of each board: X, then Y.

    ``normal`` are unit normals in columns and lines, ``reach`` the lines that an edge crosses in a window, over its
    size; ``meet`` takes what both lines are off along their normals to what the corner is off.
    """

    normal: Float[Tensor, "boards 2 2"]
    reach: Float[Tensor, "boards 2"]
    meet: Float[Tensor, "boards 2 2"]
    spacing_mm: float

    @classmethod
    def of(cls, problem: BoardProblem, state: Float[Tensor, " state"]) -> "Windows":
        """Those of a problem of batch shape () in a state near the solution."""
        edges = scan_position(rotations(problem, state).mT[:, :2], BoardState.split(state).n)[..., :2]
        edges = edges / torch.linalg.vector_norm(edges, dim=-1, keepdim=True)
        normal = torch.stack([edges[..., 1], -edges[..., 0]], dim=-1)
        apart = torch.cdist(problem.body_points, problem.body_points)
        itself = torch.eye(apart.shape[-1], dtype=torch.bool)  # a distance that rounding makes nearly nothing
        apart[~(problem.valid[:, :, None] & problem.valid[:, None]) | itself] = torch.inf
        return cls(
            normal=normal,
            reach=edges[..., 1].abs() / edges.abs().amax(-1),
            meet=torch.linalg.inv(normal),
            spacing_mm=float(apart.amin()),
        )

    def displaced(self, processes: Processes, points: Tensor, half_mm: float) -> Float[Tensor, "boards corners 3"]:
        """What measured points ``(boards, corners, 3)``, mm, are found off by in windows of 2 ``half_mm``."""
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        here, zero = processes.displaced(points), torch.zeros_like(points[..., 0])
        levelled = zero.new_zeros(2, *points.shape)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            for edge in range(2):
                along = zero + (node * half_mm * self.reach[:, edge])[:, None]
                there = points + torch.stack([zero, along, zero], dim=-1)
                levelled[edge] += 0.5 * weight * (processes.displaced(there) - here)
        by_depth = -(points[..., 0] - processes.lever.middle[:, None, 0]) / points[..., 2]
        by_depth = by_depth.nan_to_num(0.0, 0.0, 0.0)
        across, along = self.normal.movedim(0, -1)[..., None].unbind(1)
        dx, dy, dz = levelled.unbind(-1)
        of_columns = torch.einsum("be,ebc->bc", self.meet[:, 0], across * dx + along * dy)
        of_lines = torch.einsum("be,ebc->bc", self.meet[:, 1], across * (dx + by_depth * dz) + along * dy)
        in_depth = torch.einsum("be,ebc->bc", self.meet[:, 0], across * dz)
        return torch.stack([of_columns, of_lines, in_depth], dim=-1)

    def off(
        self, processes: Processes, problem: BoardProblem, left: Float[Tensor, "boards corners 3"]
    ) -> Float[Tensor, "boards corners 3"]:
        """What corners are found off by, mm, in windows of the size that explains most of their residuals.

        Args:
            left: residuals of the corners in sigmas, the motion of their lines taken away.
        """
        half, largest = _FIRST_SHARE * self.spacing_mm, _LARGEST_SHARE * self.spacing_mm
        for _ in range(_ROUNDS):
            off = torch.where(problem.valid[..., None], self.displaced(processes, problem.points, half), 0.0)
            shown = torch.linalg.solve_triangular(problem.noise_chol, off[..., None], upper=False)[..., 0]
            part = float((left * shown).sum() / shown.square().sum().clamp(min=1e-300))
            if not part > 0.0:
                return torch.zeros_like(off)
            half = min(half * part**0.5, largest)
        return torch.where(problem.valid[..., None], self.displaced(processes, problem.points, half), 0.0)
