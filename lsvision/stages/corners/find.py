"""Scan -> corners: the board's corners in both images, as measured (x, travel, z) with covariance."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import (
    Rectification,
    depth_map_jacobian,
    object_pitch_mm,
    slope_at,
    travel_at,
    triangulate,
    triangulation_jacobian,
)
from lsvision.image.board.detect import SeenBoard, locate_corners, look_for_board
from lsvision.image.board.refine import DetectedCorners
from lsvision.image.planes import fit_local_planes
from lsvision.stages.corners.by_rig import points_by_rig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.corners.ideal import IdealCorners
from lsvision.stages.corners.pairing import pair_lattices
from lsvision.stages.corners.rows import RowDifference
from lsvision.types import Board, BoardCorners, DepthView, LineImage, Scan, StereoPair, Travel


@dataclass(frozen=True)
class _Measured:
    """Corners as measured: (x, travel, z) mm, their covariance, mm², and which were seen, where."""

    points: Tensor
    covariance: Tensor
    valid: Tensor
    left_px: Tensor
    right_px: Tensor | None = None
    by_rig: Tensor | None = None
    later_mm: Tensor | None = None


@dataclass(frozen=True)
class LocatedCorners:
    """Corners of a board in the images of a scan, in the order of ``Board.corner_points``; ``right`` is None where a
    depth map replaces the right image.
    """

    left: DetectedCorners
    right: DetectedCorners | None


def find_corners(scan: Scan, board: Board, config: CornersConfig | None = None) -> BoardCorners:
    """Find a board in a scan and measure its corners.

    Corner depth comes from the corners found in both images: squares have no texture and their edges along the sensor
    no disparity, so a matched depth map knows little there. Only a scan that has no second image takes its depth map.

    Raises:
        BoardNotFoundError: no board, or fewer than ``min_corners`` corners, in one of the images; names the scan.
    """
    return measure_corners(scan, board, locate_in_images(scan, board), config)


def locate_in_images(scan: Scan, board: Board) -> LocatedCorners:
    """Find the corners of a board in the images of a scan.

    Raises:
        BoardNotFoundError: no board in one of the images, or none that both show; names the scan.
    """
    match scan.images:
        case StereoPair(_, right_image):
            return LocatedCorners(*_detect_in_both(scan, right_image, board))
        case DepthView():
            [left] = _located(scan, [scan.left], [_look(scan, scan.left, "left", board)], board)
            return LocatedCorners(left, None)


def measure_corners(
    scan: Scan,
    board: Board,
    located: LocatedCorners,
    config: CornersConfig | None = None,
    n: Float[Tensor, "3"] | None = None,
) -> BoardCorners:
    """Measure the corners that were located in the images of a scan.

    Args:
        n: motion of the object, by which the cameras of a raw rig see it moved between their planes; nominal if None.

    Raises:
        BoardNotFoundError: fewer than ``min_corners`` were measured; names the scan.
    """
    config = config or CornersConfig()
    if located.right is not None:
        measured = _triangulated(scan, located.left, located.right, config, Rectification.of(scan.raw_rig, n))
    elif isinstance(scan.images, DepthView):
        measured = _from_depth_map(scan, located.left, scan.images.depth, config)
    else:
        raise ValueError("located.right: expected the corners of the right image of a scan with two images")
    valid = measured.valid
    if int(valid.sum()) < config.min_corners:
        raise BoardNotFoundError(
            f"{scan.path}: only {int(valid.sum())} of {len(valid)} corners of the board were measured, "
            f"{config.min_corners} are needed"
        )
    return BoardCorners(
        scan=str(scan.path),
        points=torch.where(valid[:, None], measured.points, torch.nan),
        covariance=torch.where(valid[:, None, None], measured.covariance, torch.nan),
        valid=valid,
        board_points=board.corner_points(),
        left_px=measured.left_px,
        right_px=measured.right_px,
        travel_mm=travel_at(scan.travel, torch.arange(scan.lines, dtype=torch.float64)),
        by_rig=None if measured.by_rig is None else torch.where(valid[:, None, None], measured.by_rig, torch.nan),
        later_mm=None if measured.later_mm is None else torch.where(valid, measured.later_mm, torch.nan),
    )


def _detect_in_both(scan: Scan, right_image: LineImage, board: Board) -> list[DetectedCorners]:
    """Corners of both images in the same order."""
    left, right = _look(scan, scan.left, "left", board), _look(scan, right_image, "right", board)
    paired = right.with_nodes(pair_lattices(scan, board, left, right))
    return _located(scan, [scan.left, right_image], [left, paired], board)


def _look(scan: Scan, image: LineImage, side: str, board: Board) -> SeenBoard:
    seen = look_for_board(image, board)
    if seen is None:
        raise BoardNotFoundError(f"{scan.path}: no board of {board.columns} x {board.rows} squares in the {side} image")
    return seen


def _located(scan: Scan, images: list[LineImage], seen: list[SeenBoard], board: Board) -> list[DetectedCorners]:
    located = locate_corners(images, seen, board, mirrored=scan.travel.transport == "reverse")
    if located is None:
        raise BoardNotFoundError(
            f"{scan.path}: too few corners of a board of {board.columns} x {board.rows} squares are seen"
        )
    return located


def _triangulated(
    scan: Scan,
    left: DetectedCorners,
    right: DetectedCorners,
    config: CornersConfig,
    rectification: Rectification | None = None,
) -> _Measured:
    """From the columns of both images and the mean of both lines, weighted by their variance.

    Where the cameras are out of step, the lines are those of the left one.
    """
    valid = left.valid & right.valid
    ideal = IdealCorners.of(left.position, right.position, rectification, scan.travel)
    right_line = ideal.right[:, 1] - _lines_out_of_step(ideal, valid)
    valid &= (left.position[:, 1] - right_line).abs() <= config.max_line_difference
    u_left, u_right = ideal.left[:, 0], ideal.right[:, 0]
    x, z = triangulate(scan.rig, u_left, u_left - u_right)
    weight = left.covariance[:, 1, 1].reciprocal()
    weight = weight / (weight + right.covariance[:, 1, 1].reciprocal())
    line = weight * left.position[:, 1] + (1 - weight) * right_line
    points = torch.stack([x, travel_at(scan.travel, line), z], dim=-1)

    pitch = _pitch_at(scan.travel, line)
    by_columns = triangulation_jacobian(scan.rig, u_left, u_left - u_right)
    by_left = _point_jacobian(by_columns.sum(-1) * ideal.left_growth[:, None], pitch * weight)
    by_right = _point_jacobian(-by_columns[..., 1] * ideal.right_growth[:, None], pitch * (1 - weight))
    covariance = by_left @ left.covariance @ by_left.mT + by_right @ right.covariance @ by_right.mT
    mixed = by_left @ left.covariance_with(right) @ by_right.mT
    covariance = covariance + mixed + mixed.mT
    n = points.new_tensor([0.0, 1.0, 0.0]) if rectification is None else rectification.n
    by_rig = points_by_rig(scan, left.position, right.position, weight, n)
    valid &= torch.isfinite(points).all(-1)
    return _Measured(points, covariance, valid, ideal.left, ideal.right, by_rig, ideal.later_mm)


def _lines_out_of_step(ideal: IdealCorners, seen: Tensor) -> float:
    """By how many lines most of the corners are later in the right image; 0 where that is no more than noise."""
    difference = RowDifference.of((ideal.right - ideal.left)[seen, 1])
    return difference.lines if difference.is_systematic else 0.0


def _from_depth_map(scan: Scan, left: DetectedCorners, depth: LineImage, config: CornersConfig) -> _Measured:
    """From one image and a depth map: z of a plane fitted around each corner.

    On a tilted board an error of the corner in the image is one in depth as well, by the slope of the plane.
    """
    column, line = left.position.unbind(-1)
    half_columns = max(2, round(config.depth_window_mm / 2 / object_pitch_mm(scan.rig)))
    half_lines = max(2, round(config.depth_window_mm / 2 / abs(scan.travel.line_pitch_mm)))
    planes = fit_local_planes(depth, left.position, left.valid, (half_columns, half_lines))
    z = planes.value
    slope = slope_at(scan.rig, column)
    points = torch.stack([slope * z, travel_at(scan.travel, line), z], dim=-1)
    by_column_and_depth = depth_map_jacobian(scan.rig, column, z)
    by_pixel = _point_jacobian(by_column_and_depth[..., 0], _pitch_at(scan.travel, line))
    by_depth = torch.stack([slope, torch.zeros_like(z), torch.ones_like(z)], -1)[..., None]
    by_pixel = by_pixel + by_depth @ planes.slope[:, None, :]
    # Seen in perspective, z of a tilted board is curved along the columns by 2 slope² / z: the plane lies that far off.
    curvature = planes.slope[:, 0].square() / z * (half_columns**2 / 3)
    variance = planes.variance + curvature.square()
    covariance = by_pixel @ left.covariance @ by_pixel.mT + by_depth @ by_depth.mT * variance[:, None, None]
    return _Measured(points, covariance, left.valid & planes.valid, left.position)


def _point_jacobian(x_z_by_column: Tensor, y_by_line: Tensor) -> Tensor:
    """Derivative (corners, 3, 2) of (x, y, z) by (column, line) of one image."""
    zero = torch.zeros_like(y_by_line)
    by_column = torch.stack([x_z_by_column[:, 0], zero, x_z_by_column[:, 1]], -1)
    return torch.stack([by_column, torch.stack([zero, y_by_line, zero], -1)], -1)


def _pitch_at(travel: Travel, line: Tensor) -> Tensor:
    """Signed travel per line, mm, at fractional lines."""
    return travel_at(travel, line + 0.5) - travel_at(travel, line - 0.5)
