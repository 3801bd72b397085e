"""Scan -> Corners: the board's corners in both images, as measured (x, travel, z) with covariance."""

import torch
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import travel_at, triangulate, triangulation_jacobian
from lsvision.image.board.detect import DetectedCorners, detect_board
from lsvision.image.planes import fit_local_planes
from lsvision.stages.corners.config import CornersConfig
from lsvision.types import Board, BoardCorners, LineImage, Scan, Travel


def find_corners(scan: Scan, board: Board, config: CornersConfig | None = None) -> BoardCorners:
    """Find a board in a scan and measure its corners.

    Corner depth comes from the corners found in both images: squares have no texture and their edges along the sensor
    no disparity, so a matched depth map knows little there. Only a scan that has no second image takes its depth map.

    Raises:
        BoardNotFoundError: no board, or fewer than ``min_corners`` corners, in one of the images; names the scan.
    """
    config = config or CornersConfig()
    left = _detect(scan, scan.left, "left", board)
    if scan.right is not None:
        right = _detect(scan, scan.right, "right", board)
        points, covariance, valid = _triangulated(scan, left, right, config)
        right_px = right.position
    else:
        assert scan.depth is not None  # a Scan has one or the other
        points, covariance, valid = _from_depth_map(scan, left, scan.depth, config)
        right_px = None
    if int(valid.sum()) < config.min_corners:
        raise BoardNotFoundError(
            f"{scan.path}: only {int(valid.sum())} of {len(valid)} corners of the board were measured, "
            f"{config.min_corners} are needed"
        )
    return BoardCorners(
        scan=str(scan.path),
        points=torch.where(valid[:, None], points, torch.nan),
        covariance=torch.where(valid[:, None, None], covariance, torch.nan),
        valid=valid,
        board_points=board.corner_points(),
        left_px=left.position,
        right_px=right_px,
    )


def _detect(scan: Scan, image: LineImage, side: str, board: Board) -> DetectedCorners:
    detected = detect_board(image, board, mirrored=scan.travel.transport == "reverse")
    if detected is None:
        raise BoardNotFoundError(f"{scan.path}: no board of {board.columns} x {board.rows} squares in the {side} image")
    return detected


def _triangulated(
    scan: Scan, left: DetectedCorners, right: DetectedCorners, config: CornersConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Points and covariance from the columns of both images and the mean of both lines, weighted by their variance."""
    valid = left.valid & right.valid
    valid &= (left.position[:, 1] - right.position[:, 1]).abs() <= config.max_line_difference
    u_left, u_right = left.position[:, 0], right.position[:, 0]
    x, z = triangulate(scan.rig, u_left, u_left - u_right)
    weight = left.covariance[:, 1, 1].reciprocal()
    weight = weight / (weight + right.covariance[:, 1, 1].reciprocal())
    line = weight * left.position[:, 1] + (1 - weight) * right.position[:, 1]
    points = torch.stack([x, travel_at(scan.travel, line), z], dim=-1)

    # Rows x, y, z by columns u_left, v_left, u_right, v_right.
    by_columns = triangulation_jacobian(scan.rig, u_left, u_left - u_right)
    by_left, by_right = by_columns.sum(-1), -by_columns[..., 1]
    pitch = _pitch_at(scan.travel, line)
    zero = torch.zeros_like(x)
    jacobian_left = torch.stack(
        [torch.stack([by_left[:, 0], zero, by_left[:, 1]], -1), torch.stack([zero, pitch * weight, zero], -1)], -1
    )
    jacobian_right = torch.stack(
        [torch.stack([by_right[:, 0], zero, by_right[:, 1]], -1), torch.stack([zero, pitch * (1 - weight), zero], -1)],
        -1,
    )
    covariance = jacobian_left @ left.covariance @ jacobian_left.mT
    covariance = covariance + jacobian_right @ right.covariance @ jacobian_right.mT
    return points, covariance, valid & torch.isfinite(points).all(-1)


def _from_depth_map(
    scan: Scan, left: DetectedCorners, depth: LineImage, config: CornersConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Points and covariance from one image and a depth map: z of a plane fitted around each corner."""
    pitch = _pitch_at(scan.travel, left.position[:, 1])
    half_columns = max(2, round(config.depth_window_mm / 2 / scan.rig.object_pitch_mm))
    half_lines = max(2, round(config.depth_window_mm / 2 / abs(scan.travel.line_pitch_mm)))
    z, variance, seen = fit_local_planes(depth, left.position, left.valid, (half_columns, half_lines))
    slope = (left.position[:, 0] - scan.rig.principal_left_px) / scan.rig.focal_length_px
    points = torch.stack([slope * z, travel_at(scan.travel, left.position[:, 1]), z], dim=-1)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    by_pixel = torch.stack(
        [torch.stack([z / scan.rig.focal_length_px, zero, zero], -1), torch.stack([zero, pitch, zero], -1)], -1
    )
    by_depth = torch.stack([slope, zero, one], -1)[..., None]
    covariance = by_pixel @ left.covariance @ by_pixel.mT + by_depth @ by_depth.mT * variance[:, None, None]
    return points, covariance, left.valid & seen


def _pitch_at(travel: Travel, line: Tensor) -> Tensor:
    """Signed travel per line, mm, at fractional lines."""
    return travel_at(travel, line + 0.5) - travel_at(travel, line - 0.5)
