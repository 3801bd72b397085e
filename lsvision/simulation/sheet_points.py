"""Points of a printed sheet, found in a scan and in its product, compared with the artwork of the sheet."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from lsvision.geometry import (
    displace,
    fit_rigid,
    line_at,
    product_pose,
    project,
    scan_position,
    slope_at,
    transform,
    travel_at,
)
from lsvision.image.brightness import gray
from lsvision.image.planes import fit_local_planes
from lsvision.simulation.artwork import artwork
from lsvision.simulation.config import SceneConfig
from lsvision.simulation.scan import Simulation
from lsvision.types import DepthSource, LineImage, ProductGrid, Scan, TensorImage

_PATCH_PX = 12  # half the side of a patch
_SEARCH_PX = 8
_DEPTH_WINDOW_PX = 12
_EDGE_MM = 15.0
_SPACING_MM = 20.0
_LEAST_CORRELATION = 0.6


@dataclass(frozen=True)
class SheetPoints:
    """Points of the sheet ``(points, 3)``, mm, in its frame: on the artwork and as measured.

    ``shift_px`` is the distance of a point in the image from its true position.
    """

    true_mm: Tensor
    measured_mm: Tensor
    shift_px: Tensor

    @property
    def rms_mm(self) -> float:
        """Root-mean-square distance between measured and true points."""
        return float((self.measured_mm - self.true_mm).square().sum(-1).mean().sqrt())

    @property
    def unsheared_rms_mm(self) -> float:
        """The same but for a shear of X by Y, which a trend of the sideways motion over the sheet looks like."""
        x, y, _ = (self.true_mm - self.true_mm.mean(0)).T
        none, one = torch.zeros_like(x), torch.ones_like(x)
        pose = (
            (one, none, none),
            (none, one, none),
            (none, none, one),
            (none, none, x),
            (none, none, y),
            (-y, x, none),
        )
        design = torch.stack([torch.stack(move) for move in (*pose, (y, none, none))], -1).flatten(0, 1)
        error = (self.measured_mm - self.true_mm).T.reshape(-1, 1)
        left = error - design @ torch.linalg.lstsq(design, error).solution
        return float((left.square().sum() / len(x)).sqrt())


def points_in_scan(scan: Scan, depth: DepthSource, simulation: Simulation) -> SheetPoints:
    """Points of the sheet measured in a scan under the nominal motion."""
    sheet, pose, n = sheet_grid(simulation.scene), simulation.pose, simulation.trajectory.n
    true = scan_position(transform(pose.rotation, pose.translation, sheet), n)
    u, _ = project(scan.rig, true[:, 0], true[:, 2])
    expected = torch.stack([u, line_at(scan.travel, true[:, 1])], dim=-1)

    def to_sheet(pixel: Tensor) -> Tensor:
        """Place on the sheet, mm, of a pixel of the scan."""
        slope = slope_at(scan.rig, pixel[..., 0])
        ray = torch.stack([slope, torch.zeros_like(slope), torch.ones_like(slope)], dim=-1)
        shifted = travel_at(scan.travel, pixel[..., 1])[..., None] * n - pose.translation
        z = -(shifted @ pose.rotation[:, 2]) / (ray @ pose.rotation[:, 2])
        return (shifted + z[..., None] * ray) @ pose.rotation

    found, seen = _find(gray(scan.left.read(0, scan.lines)), expected, to_sheet, simulation.scene)
    depth_map = TensorImage(depth.read(0, depth.lines).z[..., None])
    planes = fit_local_planes(depth_map, found, seen, (_DEPTH_WINDOW_PX, _DEPTH_WINDOW_PX))
    z, slope = planes.value, slope_at(scan.rig, found[:, 0])
    measured = displace(torch.stack([slope * z, travel_at(scan.travel, found[:, 1]), z], -1), n.new_tensor([0, 1, 0]))
    return _sheet_points(sheet, measured, found - expected, seen & planes.valid)


def points_in_product(
    color: LineImage, height: LineImage, grid: ProductGrid, n: Tensor, simulation: Simulation
) -> SheetPoints:
    """Points of the sheet measured in a product that was made with a motion n."""
    sheet, pose = sheet_grid(simulation.scene), product_pose(simulation.pose, n)
    rotation, translation = pose.rotation, pose.translation
    origin = n.new_tensor([grid.origin_x_mm, grid.origin_y_mm])
    expected = (transform(rotation, translation, sheet)[:, :2] - origin) / grid.pitch_mm

    def to_sheet(pixel: Tensor) -> Tensor:
        """Place on the sheet, mm, of a cell of the product."""
        q = pixel * grid.pitch_mm + origin - translation[:2]
        normal = rotation[:, 2]
        q_z = -(q @ normal[:2]) / normal[2]
        return torch.cat([q, q_z[..., None]], dim=-1) @ rotation

    found, seen = _find(gray(color.read(0, color.shape[0])), expected, to_sheet, simulation.scene)
    planes = fit_local_planes(height, found, seen, (_DEPTH_WINDOW_PX, _DEPTH_WINDOW_PX))
    measured = torch.cat([found * grid.pitch_mm + origin, -planes.value[:, None]], dim=-1)
    return _sheet_points(sheet, measured, found - expected, seen & planes.valid)


def sheet_grid(scene: SceneConfig) -> Tensor:
    """Points every 20 mm over the sheet, ``(points, 3)`` mm in its frame."""
    x = torch.arange(_EDGE_MM, scene.sheet_width_mm - _EDGE_MM, _SPACING_MM, dtype=torch.float64)
    y = torch.arange(_EDGE_MM, scene.sheet_height_mm - _EDGE_MM, _SPACING_MM, dtype=torch.float64)
    xy = torch.cartesian_prod(x, y)
    return torch.cat([xy, torch.zeros_like(xy[:, :1])], dim=-1)


def _sheet_points(sheet: Tensor, measured: Tensor, shift: Tensor, valid: Tensor) -> SheetPoints:
    pose = fit_rigid(sheet[valid], measured[valid])
    in_sheet = (measured[valid] - pose.translation) @ pose.rotation
    return SheetPoints(sheet[valid], in_sheet, torch.linalg.vector_norm(shift[valid], dim=-1))


def _find(
    image: Tensor, expected: Tensor, to_sheet: Callable[[Tensor], Tensor], scene: SceneConfig
) -> tuple[Tensor, Tensor]:
    """Positions (column, row), px, of patches of the artwork near the expected ones, and which patches were found."""
    span = torch.arange(-_PATCH_PX, _PATCH_PX + 1, dtype=torch.float64)
    offset = torch.stack(torch.meshgrid(span, span, indexing="xy"), dim=-1)
    centre = expected.round()  # patches are drawn on whole pixels; a match gives the shift from there
    patches = gray(artwork(scene, to_sheet(centre[:, None, None] + offset)).flatten(0, 1)).reshape(
        -1, *offset.shape[:2]
    )
    found, seen = torch.full_like(expected, torch.nan), torch.zeros(len(expected), dtype=torch.bool)
    reach = _PATCH_PX + _SEARCH_PX
    for index, (patch, (column, row)) in enumerate(zip(patches, centre.long().tolist(), strict=True)):
        window = image[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        if window.shape != (2 * reach + 1, 2 * reach + 1) or not bool(torch.isfinite(patch).all()):
            continue
        score = cv2.matchTemplate(window.numpy(), patch.to(torch.float32).numpy(), cv2.TM_CCOEFF_NORMED)
        peak = _peak(score)
        if peak is not None:
            found[index] = expected[index] + peak - _SEARCH_PX
            seen[index] = True
    return found, seen


def _peak(score: np.ndarray) -> Tensor | None:
    """Sub-pixel position (column, row) of the largest correlation; None at the rim or if the correlation is weak."""
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    if score[row, column] < _LEAST_CORRELATION:
        return None
    if not (0 < row < score.shape[0] - 1 and 0 < column < score.shape[1] - 1):
        return None
    across, down = score[row, column - 1 : column + 2], score[row - 1 : row + 2, column]
    return torch.tensor([column + _vertex(across), row + _vertex(down)], dtype=torch.float64)


def _vertex(values: np.ndarray) -> float:
    """Vertex of the parabola through values at -1, 0 and 1."""
    before, here, after = (float(value) for value in values)
    return 0.5 * (before - after) / (before - 2 * here + after)
