"""Scan -> the edges of a board's squares: where every line crosses them, in both images.

Corners lie 30 mm apart along the travel; the edges between them cross every line, and show what happens in between.
"""

import torch
from torch import Tensor

from lsvision.geometry import Rectification, travel_at, triangulate, triangulation_jacobian
from lsvision.image.board.edges import EdgeSegments, common_lines, find_crossings
from lsvision.stages.corners.rows import row_difference
from lsvision.types import Board, BoardCorners, BoardEdges, Scan, StereoPair


def find_edges(scan: Scan, board: Board, corners: BoardCorners) -> BoardEdges | None:
    """Locate the edges between neighbouring corners on every line.

    Edges that lie along the lines, which hardly cross any, are left out.

    Returns:
        None where there is no second image, or the cameras are out of step or look at planes of their own: one line
        then shows two moments.
    """
    if Rectification.of(scan.raw_rig) is not None:
        return None
    difference = row_difference(corners)
    if not isinstance(scan.images, StereoPair) or corners.right_px is None or difference is None:
        return None
    if difference.is_systematic:
        return None
    left, right = (_segments(pixels, board) for pixels in (corners.left_px, corners.right_px))
    segment, line = common_lines(left, right)
    in_left = find_crossings(scan.images.left, left, segment, line)
    in_right = find_crossings(scan.images.right, right, segment, line)
    disparity = in_left.column - in_right.column
    x, z = triangulate(scan.rig, in_left.column, disparity)
    points = torch.stack([x, travel_at(scan.travel, line.double()), z], dim=-1)
    seen = in_left.valid & in_right.valid & (in_left.step * in_right.step > 0) & torch.isfinite(points).all(-1)
    by_left, by_disparity = triangulation_jacobian(scan.rig, in_left.column, disparity).unbind(-1)
    start, stop = (ends[segment[seen]] for ends in ends_of_edges(corners.board_points, board))
    return BoardEdges(
        scan=corners.scan,
        points=points[seen],
        by_column=torch.stack([by_left, by_disparity + by_left / 2], dim=-1)[seen],
        sigma_px=((in_left.variance + in_right.variance) / 2).sqrt()[seen],
        start=start,
        stop=stop,
        segment=segment[seen],
        line=line[seen],
    )


def _segments(pixels: Tensor, board: Board) -> EdgeSegments:
    start, stop = ends_of_edges(pixels, board)
    across = torch.linalg.vector_norm(stop - start, dim=-1)[-(board.inner[0] - 1) * board.inner[1] :]
    return EdgeSegments(start, stop, float(across.nanmedian()))


def ends_of_edges(corners: Tensor, board: Board) -> tuple[Tensor, Tensor]:
    """From every corner to the next one along Y, then to the next along X: ``(segments, ..)`` each."""
    grid = corners.unflatten(0, (board.inner[1], board.inner[0]))
    start = torch.cat([grid[:-1].flatten(0, 1), grid[:, :-1].flatten(0, 1)])
    return start, torch.cat([grid[1:].flatten(0, 1), grid[:, 1:].flatten(0, 1)])
