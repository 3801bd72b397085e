"""The edges of the boards' squares on lines of the scan, as the cameras of a study would see them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lsvision.geometry import mean_column_jacobian, project, scan_position, transform
from lsvision.stages.corners.edges import ends_of_edges
from lsvision.types import Board, BoardEdges, Pose, Rig

_PITCH_MM = 0.28  # of the lines: every fourth of a full-size camera shows vibrations as well as all do
_RIM = 0.2  # share of an edge at either end that is left out, as in an image
_STEEPEST = 2.0  # mm across per mm along: a flatter edge is a blur along the line


def exact_edges(
    rig: Rig, board: Board, pose: Pose, n: Float[Tensor, "3"], line_pitch_mm: float = _PITCH_MM
) -> BoardEdges:
    """The edges of a board that moves by n, without noise.

    Args:
        pose: of the board before it moves. line_pitch_mm: between the lines on which the edges are seen.
    """
    ends = ends_of_edges(board.corner_points(), board)
    start, stop = (scan_position(transform(pose.rotation, pose.translation, points), n) for points in ends)
    crossings = _Crossings.of(start, stop, line_pitch_mm)
    segment = crossings.segment
    points = torch.lerp(start[segment], stop[segment], crossings.share[:, None])
    left, right = project(rig, points[:, 0], points[:, 2])
    return BoardEdges(
        scan="",
        points=points,
        by_column=mean_column_jacobian(rig, left, left - right),
        sigma_px=torch.ones_like(left),
        start=ends[0][segment],
        stop=ends[1][segment],
        segment=segment,
        line=crossings.line,
    )


def with_noise(edges: BoardEdges, sigma_mm: Float[Tensor, "2"], generator: torch.Generator) -> BoardEdges:
    """Edges with white noise.

    Args:
        sigma_mm: what errors of the mean column displace a crossing by sideways, and those of the disparity in depth.
    """
    mm_per_px = edges.by_column.diagonal(dim1=-2, dim2=-1)
    columns = torch.randn(mm_per_px.shape, generator=generator, dtype=mm_per_px.dtype) * sigma_mm / mm_per_px
    points = edges.points.clone()
    points[:, ::2] += (edges.by_column @ columns[..., None])[..., 0]
    return replace(edges, points=points)


@dataclass(frozen=True)
class _Crossings:
    """Which line crosses which edge, and at which share of the way from its start to its stop."""

    segment: Int[Tensor, " crossings"]
    line: Int[Tensor, " crossings"]
    share: Float[Tensor, " crossings"]

    @classmethod
    def of(cls, start: Float[Tensor, "segments 3"], stop: Float[Tensor, "segments 3"], pitch_mm: float) -> "_Crossings":
        """Of edges between measured points, mm."""
        across, along, _ = (stop - start).unbind(-1)
        first, last = torch.stack([start[:, 1], stop[:, 1]]).aminmax()
        lines = torch.arange(int(first / pitch_mm), int(last / pitch_mm) + 1)
        share = (lines * pitch_mm - start[:, 1:2]) / along[:, None]
        seen = (share > _RIM) & (share < 1.0 - _RIM) & (across.abs() <= _STEEPEST * along.abs())[:, None]
        segment, index = seen.nonzero().unbind(-1)
        return cls(segment, lines[index], share[segment, index])
