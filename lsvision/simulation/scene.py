"""Pose of a target, and the conveyor and lights around it."""

import math

import torch
from torch import Tensor

from lsvision.geometry import aligned_rotation, middle_point, rotation_from_vector
from lsvision.simulation.config import SceneConfig
from lsvision.simulation.lighting import line_lights
from lsvision.simulation.rail import RailScene
from lsvision.simulation.reference import ReferenceScene
from lsvision.simulation.surfaces import BoardScene, Conveyor, Scene, SheetScene, squares_of
from lsvision.types import Board, Pose, Rig


def place(rig: Rig, board: Board, scene: SceneConfig, n: Tensor, middle_mm: float) -> Pose:
    """Pose of a target whose centre crosses the scan plane midway between the cameras at the travel ``middle_mm``.

    Y of a rail's frame runs along the motion n; roll turns the rail about it.
    """
    middle = middle_point(rig) + n.new_tensor([0.0, 0.0, scene.depth_offset_mm]) + middle_mm * n
    if scene.kind == "rail":
        rotation = aligned_rotation(n) @ _turn(0.0, scene.roll_deg, 0.0)
        return Pose(rotation, middle - scene.rail_rise_mm * _height_axis(n))
    if scene.is_endless:
        return Pose(aligned_rotation(n) @ _turn(0.0, scene.roll_deg, 0.0), middle)
    rotation = _turn(scene.pitch_deg, scene.roll_deg, scene.yaw_deg)
    outline = _outline(board, scene)
    center = torch.cat([outline.mean(0), outline.new_zeros(1)])
    return Pose(rotation, middle - rotation @ center)


def scene_lines(board: Board, scene: SceneConfig, n: Tensor, line_pitch_mm: float) -> int:
    """Lines of a scan that shows the whole target and its margin, or ``rail_length_mm`` of an endless object."""
    if scene.is_endless:
        return math.ceil(scene.rail_length_mm / line_pitch_mm)
    rotation = _turn(scene.pitch_deg, scene.roll_deg, scene.yaw_deg)
    travel = _outline(board, scene) @ rotation[1, :2] / n[1]
    return math.ceil((float(travel.max() - travel.min()) + 2 * scene.margin_mm) / line_pitch_mm)


def build_scene(rig: Rig, board: Board, scene: SceneConfig, pose: Pose, n: Tensor) -> Scene:
    """Target, conveyor and lights; conveyor and rail run along the motion n."""
    lighting = line_lights(rig, scene.lights)
    ground = middle_point(rig) + scene.conveyor_drop_mm * _height_axis(n)
    conveyor = Conveyor(Pose(aligned_rotation(n), ground), lighting, scene.texture_mm, scene.seed)
    if scene.kind == "board":
        return BoardScene(board, scene, pose, lighting, conveyor)
    if scene.kind == "sheet":
        return SheetScene(scene, pose, lighting, conveyor)
    if scene.kind in ("white", "dark"):
        return ReferenceScene(scene, pose, lighting)
    return RailScene(scene, pose, lighting, conveyor)


def _height_axis(n: Tensor) -> Tensor:
    """e_z of the product frame, along which rise and drop are measured as heights are, away from the cameras."""
    return aligned_rotation(n)[:, 2]


def _outline(board: Board, scene: SceneConfig) -> Tensor:
    """Corners (4, 2) of a board or sheet in its own frame, mm."""
    if scene.kind == "board":
        squares = squares_of(board)
        border = torch.tensor([scene.board_border_x_mm, scene.board_border_y_mm], dtype=torch.float64)
        low = -squares.side_mm - border
        high = torch.tensor([squares.right_mm, squares.bottom_mm], dtype=torch.float64) + border
    else:
        high = torch.tensor([scene.sheet_width_mm, scene.sheet_height_mm], dtype=torch.float64)
        low = torch.zeros_like(high)
    return torch.cartesian_prod(*torch.stack([low, high], dim=-1))


def _turn(pitch_deg: float, roll_deg: float, yaw_deg: float) -> Tensor:
    """Rotation Rz(yaw) Ry(roll) Rx(pitch), float64."""
    pitch, roll, yaw = rotation_from_vector(torch.tensor([pitch_deg, roll_deg, yaw_deg]).double().deg2rad().diag())
    return yaw @ roll @ pitch
