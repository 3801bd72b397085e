"""Scan -> the edges of a board's squares: where every line crosses them, in both images.

Corners lie 30 mm apart along the travel; the edges between them cross every line, and show what happens in between.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import Rectification, line_at, mean_column_jacobian, travel_at, triangulate
from lsvision.image.board.edges import EdgeSegments
from lsvision.stages.corners.crossed import CrossedPair, same_lines, same_points
from lsvision.stages.corners.rows import row_difference
from lsvision.types import Board, BoardCorners, BoardEdges, Scan, StereoPair


def find_edges(scan: Scan, board: Board, corners: BoardCorners, n: Tensor | None = None) -> BoardEdges | None:
    """Locate the edges between neighbouring corners on every line.

    Edges that lie along the lines, which hardly cross any, are left out. Where a raw pair's cameras look at planes of
    their own, a crossing of the left image belongs to that of the right one on the (fractional) line that shows the
    same point of the object.

    Args:
        n: motion of the object, by which the cameras of a raw rig see it moved between their planes; nominal if None.

    Returns:
        None where there is no second image, or the cameras are out of step.
    """
    rectification = Rectification.of(scan.raw_rig, n)
    difference = row_difference(corners)
    if not isinstance(scan.images, StereoPair) or corners.right_px is None or difference is None:
        return None
    if difference.is_systematic:
        return None
    left, right = (_segments(pixels, board) for pixels in _in_images(corners, scan, rectification))
    if rectification is None or not bool(rectification.raw.plane.any()):
        crossed = same_lines(scan.images, left, right)
    else:
        crossed = same_points(scan.images, left, right, rectification, scan.travel)
    placed = _Placed.of(crossed, scan, rectification)
    seen = crossed.valid & torch.isfinite(placed.points).all(-1)
    start, stop = (ends[crossed.segment[seen]] for ends in ends_of_edges(corners.board_points, board))
    return BoardEdges(
        scan=corners.scan,
        points=placed.points[seen],
        by_column=placed.by_column[seen],
        sigma_px=crossed.sigma_px[seen],
        start=start,
        stop=stop,
        segment=crossed.segment[seen],
        line=crossed.line[seen],
        later_mm=None if crossed.later_mm is None else crossed.later_mm[seen],
    )


@dataclass(frozen=True)
class _Placed:
    """Crossings as (x, travel, z), and the derivative of (x, z) by mean column and disparity."""

    points: Float[Tensor, "crossings 3"]
    by_column: Float[Tensor, "crossings 2 2"]

    @classmethod
    def of(cls, crossed: CrossedPair, scan: Scan, rectification: Rectification | None) -> "_Placed":
        """By the rig of a scan."""
        if rectification is None:
            disparity = crossed.left_px - crossed.right_px
            x, z = triangulate(scan.rig, crossed.left_px, disparity)
            by_column = mean_column_jacobian(scan.rig, crossed.left_px, disparity)
        else:
            x, z = _met(rectification, crossed.left_px, crossed.right_px).unbind(-1)
            by_column = _met_by_column(rectification, crossed.left_px, crossed.right_px)
        return cls(torch.stack([x, travel_at(scan.travel, crossed.line.double()), z], dim=-1), by_column)


def _met(rectification: Rectification, left_px: Tensor, right_px: Tensor) -> Float[Tensor, "crossings 2"]:
    met = rectification.raw.meet(left_px, right_px, rectification.n)
    return torch.stack([met.x, met.z], dim=-1)


def _met_by_column(rectification: Rectification, left_px: Tensor, right_px: Tensor) -> Float[Tensor, "crossings 2 2"]:
    """Derivative of (x, z) by the mean of both columns and by their difference, over a column."""
    moves = ((0.5, 0.5), (0.25, -0.25))
    steps = [
        _met(rectification, left_px + a, right_px + b) - _met(rectification, left_px - a, right_px - b)
        for a, b in moves
    ]
    return torch.stack(steps, dim=-1)


def _in_images(corners: BoardCorners, scan: Scan, rectification: Rectification | None) -> tuple[Tensor, Tensor]:
    """Where both images, as they were taken, show the corners, which are stated in the ideal ones."""
    left, right = corners.left_px, corners.right_px
    assert right is not None
    if rectification is None:
        return left, right
    later = rectification.meet(left[:, 0], left[:, 0] - right[:, 0]).later_mm
    line = line_at(scan.travel, travel_at(scan.travel, right[:, 1]) + later)
    of_left, of_right = rectification.raw_column(left[:, 0]), rectification.raw_column(right[:, 0], "right")
    return torch.stack([of_left, left[:, 1]], dim=-1), torch.stack([of_right, line], dim=-1)


def _segments(pixels: Tensor, board: Board) -> EdgeSegments:
    start, stop = ends_of_edges(pixels, board)
    across = torch.linalg.vector_norm(stop - start, dim=-1)[-(board.inner[0] - 1) * board.inner[1] :]
    return EdgeSegments(start, stop, float(across.nanmedian()))


def ends_of_edges(corners: Tensor, board: Board) -> tuple[Tensor, Tensor]:
    """From every corner to the next one along Y, then to the next along X: ``(segments, ..)`` each."""
    grid = corners.unflatten(0, (board.inner[1], board.inner[0]))
    start = torch.cat([grid[:-1].flatten(0, 1), grid[:, :-1].flatten(0, 1)])
    return start, torch.cat([grid[1:].flatten(0, 1), grid[:, 1:].flatten(0, 1)])
