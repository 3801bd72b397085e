"""Edges of synthetic boards: where their lines cross them, under vibration and noise of the columns."""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from lsvision.geometry import (
    middle_point,
    project,
    scan_position,
    shaken,
    transform,
    triangulate,
    triangulation_jacobian,
)
from lsvision.types import BoardCorners, BoardEdges
from tests.stages.calibration.boards import RIG, Corners

COLUMN_SIGMA, DISPARITY_SIGMA = 0.03, 0.02  # px
Motion = Callable[[Tensor], Tensor]
"""Takes travel ``(boards, points)`` to (δx, δz, ρ, δy)."""


def edges_of(corners: Corners, motion: Motion, pitch_mm: float = 0.6, later_mm: float = 0.0) -> list[BoardEdges]:
    """The edges along Y of every board, with white noise of the mean column and of the disparity.

    The right camera sees them ``later_mm`` after the left one.
    """
    grid = corners.board_points[0].unflatten(0, (8, 11))
    start, stop = grid[:-1].flatten(0, 1), grid[1:].flatten(0, 1)
    boards = []
    for board in range(len(corners.rotation)):
        ends = [
            scan_position(transform(corners.rotation[board], corners.translation[board], side), corners.n)
            for side in (start, stop)
        ]
        lines = torch.arange(int(ends[0][:, 1].min() / pitch_mm), int(ends[1][:, 1].max() / pitch_mm) + 1)
        share = (lines * pitch_mm - ends[0][:, 1:2]) / (ends[1][:, 1:2] - ends[0][:, 1:2])
        segment, index = ((share > 0.2) & (share < 0.8)).nonzero().unbind(-1)
        still = torch.lerp(ends[0][segment], ends[1][segment], share[segment, index][:, None])
        boards.append(_seen(board, still, (start[segment], stop[segment]), (segment, lines[index]), motion, later_mm))
    return boards


def _seen(board: int, still: Tensor, ends, numbers, motion: Motion, later_mm: float) -> BoardEdges:
    travel = still[:, 1].expand(board + 1, -1)  # of the boards up to this one, as the motion is drawn board by board
    left, right = (
        project(RIG, *shaken(still[:, ::2], motion(travel + later)[board], middle_point(RIG)).unbind(-1))[camera]
        for camera, later in enumerate((0.0, later_mm))
    )
    noise = torch.randn(2, len(left), dtype=torch.float64)
    column, disparity = COLUMN_SIGMA * noise[0], DISPARITY_SIGMA * noise[1]
    left, right = left + column + disparity / 2, right + column - disparity / 2
    by_left, by_disparity = triangulation_jacobian(RIG, left, left - right).unbind(-1)
    x, z = triangulate(RIG, left, left - right)
    return BoardEdges(
        scan=f"scan_{board}",
        points=torch.stack([x, still[:, 1], z], -1),
        by_column=torch.stack([by_left, by_disparity + by_left / 2], -1),
        sigma_px=torch.full_like(x, 0.02),
        start=ends[0],
        stop=ends[1],
        segment=numbers[0],
        line=numbers[1],
        later_mm=torch.full_like(x, later_mm) if later_mm else None,
    )


def with_lines(corners: Corners, pitch_mm: float = 0.6, beyond_mm: float = 20.0) -> list[BoardCorners]:
    """The boards in scans that reach beyond them."""
    boards = []
    for board in corners.boards():
        first, last = (float(side) for side in board.points[:, 1].aminmax())
        lines = torch.arange(first - beyond_mm, last + beyond_mm, pitch_mm, dtype=torch.float64)
        boards.append(dataclasses.replace(board, travel_mm=lines))
    return boards
