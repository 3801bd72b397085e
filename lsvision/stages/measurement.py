"""Boards as a check: what one measures in a corrected image, and how well it fits a motion it had no part in."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.geometry import displace, fit_rigid
from lsvision.image.board.search import search_board
from lsvision.image.planes import fit_local_planes
from lsvision.types import Board, BoardCorners, LineImage, ProductGrid


@dataclass(frozen=True)
class BoardMeasurement:
    """A board measured in a product.

    ``points (corners, 3)`` are (q_x, q_y, -height) in mm, NaN where a corner was not seen. ``neighbour_rms_mm`` is the
    rms error of the distances between neighbouring corners, ``distance_rms_mm`` that between all pairs.
    """

    points: Tensor
    valid: Tensor
    neighbour_rms_mm: float
    distance_rms_mm: float


def measure_board(color: LineImage, height: LineImage, grid: ProductGrid, board: Board) -> BoardMeasurement | None:
    """Find a board in a product, take its corners' height from planes fitted around them, and compare all distances.

    Returns None where the product shows no board.
    """
    corners = search_board(color, board, grid.pitch_mm)
    if corners is None:
        return None
    half = max(3, round(board.square_mm / grid.pitch_mm))
    planes = fit_local_planes(height, corners.position, corners.valid, (half, half))
    level, seen = planes.value, planes.valid
    origin = torch.tensor([grid.origin_x_mm, grid.origin_y_mm], dtype=torch.float64)
    points = torch.cat([corners.position * grid.pitch_mm + origin, -level[:, None]], dim=-1)
    neighbour, distance = distance_errors(points, board, seen)
    return BoardMeasurement(torch.where(seen[:, None], points, torch.nan), seen, neighbour, distance)


def fitted_rmse_mm(corners: BoardCorners, n: Tensor) -> float:
    """RMSE of a board's corners under the motion n ``(3,)``, mm, at the pose that fits best."""
    moved, valid = displace(corners.points, n), corners.valid
    pose = fit_rigid(corners.board_points, moved, valid)
    residual = corners.board_points @ pose.rotation.mT + pose.translation - moved
    return float(residual[valid].square().sum(-1).mean().sqrt())


def distance_errors(points: Tensor, board: Board, valid: Tensor) -> tuple[float, float]:
    """Rms error, mm, of the distances between neighbouring corners and between all pairs of valid corners.

    Args:
        points: measured corners ``(corners, 3)``, mm, in the board's order.
    """
    truth = board.corner_points()[valid]
    true_distance = torch.cdist(truth, truth, compute_mode="donot_use_mm_for_euclid_dist")
    seen = points[valid]
    error = torch.cdist(seen, seen, compute_mode="donot_use_mm_for_euclid_dist") - true_distance
    pairs = torch.triu(torch.ones_like(error, dtype=torch.bool), diagonal=1)
    neighbours = pairs & (true_distance < 1.2 * board.square_mm)  # a diagonal is 1.41 squares long
    return float(error[neighbours].square().mean().sqrt()), float(error[pairs].square().mean().sqrt())
