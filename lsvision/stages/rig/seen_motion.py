"""Where a displaced line shows the corners of boards: derivatives in both raw images, edge by edge."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import jacobian
from lsvision.geometry import rotation_from_vector, scan_position
from lsvision.stages.rig.solve import RigSolution


@dataclass(frozen=True)
class SeenMotion:
    """Displacements of the lines in the images, about a solution of one problem.

    ``points`` are where the corners lie when the left camera sees them, (x, travel, z) mm. ``by_edge`` is the
    derivative of where a camera sees the corner, (column, travel), by what displaces each of its edges, X and Y,
    by (x, travel, z); their sum is that of what displaces both. ``reach`` is the travel that an edge goes in a window,
    over its size.
    """

    points: Float[Tensor, "boards corners 3"]
    by_edge: Float[Tensor, "boards corners 2 edges 2 3"]
    reach: Float[Tensor, "boards edges"]

    @classmethod
    def of(cls, solution: RigSolution) -> "SeenMotion":
        """Those of all corners."""
        model, state, n = solution.model, solution.found.state, solution.shared.n
        points, pair = model.placed(state), solution.pair
        axes = (rotation_from_vector(state.own[:, :3]) @ model.start.rotation).mT[:, :2]

        def seen(move: Tensor) -> Float[Tensor, "boards corners 2 2"]:
            """Of a line displaced by the first three, and of a point moved along the board's axes by the others."""
            displaced = torch.stack([move[0], move.new_zeros(()), move[2]])
            moved = points + displaced + (move[3:] @ axes)[:, None]
            both = [camera(moved, n) for camera in (pair.seen_left, pair.seen_right)]
            return torch.stack([torch.stack([eye.column, eye.travel + move[1]], dim=-1) for eye in both], dim=-2)

        by_place, along = jacobian(seen, points.new_zeros(5)).split([3, 2], dim=-1)
        normals = torch.stack([along[..., 1, :], -along[..., 0, :]], dim=-1)
        # Of columns in px and travels in mm: where lines meet is the same in any units.
        meet = torch.linalg.inv(normals)
        by_edge = meet.mT[..., :, None] * (normals @ by_place)[..., :, None, :]
        ahead = scan_position(points, n)
        edges = scan_position(axes, n)[..., :2]
        return cls(ahead, by_edge, edges[..., 1].abs() / edges.abs().amax(-1))
